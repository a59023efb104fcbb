"""Diagnosis of common mistakes in submissions, such as depth in millimetres or pictures in another order.

It is a hint for the author, computed from a few views and the ground truth; results and rankings never contain it.
"""
