"""Prometheus metrics of requests and of the submission queue."""

from __future__ import annotations

import time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from sqlalchemy import func, select

from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import DELETED, FAILED, QUEUED, SCORED, SCORING


class ServiceMetrics:
    """Prometheus counters, histograms and gauges in a separate registry."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "rebar_requests_total",
            "Number of HTTP requests",
            ["method", "route", "status"],
            registry=self.registry,
        )
        self.request_seconds = Histogram(
            "rebar_request_seconds", "Duration of HTTP requests", ["method", "route"], registry=self.registry
        )
        self._submissions = Gauge(
            "rebar_submissions", "Number of submissions by status", ["status"], registry=self.registry
        )
        self._oldest = Gauge(
            "rebar_oldest_queued_seconds", "Waiting time of the oldest queued submission", registry=self.registry
        )

    def update_queue_gauges(self, database: Database) -> None:
        """Set the gauges for submissions by status and for the waiting time of the oldest queued submission."""
        query = select(SubmissionModel.status, func.count()).group_by(SubmissionModel.status)
        oldest_query = select(func.min(SubmissionModel.created_at)).where(SubmissionModel.status == QUEUED)
        with database.read() as session:
            counts = dict(row._tuple() for row in session.execute(query))
            oldest = session.scalar(oldest_query)
        self._oldest.set(0 if oldest is None else max(0.0, time.time() - oldest))
        for status in (QUEUED, SCORING, SCORED, FAILED, DELETED):
            self._submissions.labels(status).set(counts.get(status, 0))
