"""Families of generated cages; ``FAMILIES`` of ``cages.generate`` lists their functions and shapes."""
