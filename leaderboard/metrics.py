"""Prometheus metrics of requests and of the submission queue."""

from __future__ import annotations

import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import DELETED, FAILED, QUEUED, SCORED, SCORING


class ServiceMetrics:
    """Prometheus counters, histograms and gauges in a separate registry."""

    def __init__(self, database: Database) -> None:
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
        self.registry.register(_QueueCollector(database))


class _QueueCollector(Collector):
    """Gauges for submissions by status and for the waiting time of the oldest queued submission."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Yield the gauges; none while the database is unavailable."""
        query = select(SubmissionModel.status, func.count()).group_by(SubmissionModel.status)
        oldest_query = select(func.min(SubmissionModel.created_at)).where(SubmissionModel.status == QUEUED)
        try:
            with self._database.read() as session:
                counts = {status: int(count) for status, count in session.execute(query)}
                oldest = session.scalar(oldest_query)
        except DATABASE_UNAVAILABLE:
            return
        submissions = GaugeMetricFamily("rebar_submissions", "Number of submissions by status", labels=["status"])
        for status in (QUEUED, SCORING, SCORED, FAILED, DELETED):
            submissions.add_metric([status], counts.get(status, 0))
        yield submissions
        waiting_s = 0.0 if oldest is None else max(0.0, time.time() - oldest)
        yield GaugeMetricFamily(
            "rebar_oldest_queued_seconds", "Waiting time of the oldest queued submission", waiting_s
        )
