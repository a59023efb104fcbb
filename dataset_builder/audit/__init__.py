"""Audit of a finished dataset folder: files, rows, and ground truth against independent sources."""

from dataset_builder.audit.report import AuditReport, Check, print_audit
from dataset_builder.audit.run import audit

__all__ = ["AuditReport", "Check", "audit", "print_audit"]
