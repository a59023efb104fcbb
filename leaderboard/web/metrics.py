"""What is counted for Prometheus."""

from __future__ import annotations

import time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from sqlalchemy import func, select

from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionRecord
from leaderboard.db.submissions import DELETED, FAILED, QUEUED, SCORED, SCORING


class Meters:
    """Counters and gauges in a registry of their own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "rebar_requests_total", "Requests answered", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "rebar_request_seconds", "Time to answer", ["method", "route"], registry=self.registry
        )
        self._submissions = Gauge("rebar_submissions", "Submissions by status", ["status"], registry=self.registry)
        self._oldest = Gauge(
            "rebar_oldest_queued_seconds", "How long the oldest queued submission waits", registry=self.registry
        )

    def read_queue(self, database: Database) -> None:
        """Read how many submissions have which status, and since when the queue waits."""
        query = select(SubmissionRecord.status, func.count()).group_by(SubmissionRecord.status)
        first = select(func.min(SubmissionRecord.created_at)).where(SubmissionRecord.status == QUEUED)
        with database.read() as session:
            counts = dict(row._tuple() for row in session.execute(query))
            oldest = session.scalar(first)
        self._oldest.set(0 if oldest is None else max(0.0, time.time() - oldest))
        for status in (QUEUED, SCORING, SCORED, FAILED, DELETED):
            self._submissions.labels(status).set(counts.get(status, 0))
