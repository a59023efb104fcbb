"""Checks a finished dataset folder: its files, its rows, and its ground truth against other sources."""

from dataset_builder.audit.report import AuditReport, Check, print_audit
from dataset_builder.audit.run import audit

__all__ = ["AuditReport", "Check", "audit", "print_audit"]
