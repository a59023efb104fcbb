"""Audit of a finished dataset folder: files, rows, and ground truth against independent sources."""

from dataset_builder.audit.auditing import audit
from dataset_builder.audit.checks import AuditReport, Check, print_audit

__all__ = ["AuditReport", "Check", "audit", "print_audit"]
