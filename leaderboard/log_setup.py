"""Structured logs: a JSON object a line on standard error, or lines for people on a terminal."""

from __future__ import annotations

import logging
import sys
from types import TracebackType

import structlog
from structlog.typing import Processor


def set_up_logs() -> None:
    """Configure the process's logs: ours, what libraries log, warnings, and the error that ends the process."""
    shown: Processor = (
        structlog.dev.ConsoleRenderer()
        if sys.stderr.isatty()
        else structlog.processors.JSONRenderer(sort_keys=True)
    )
    common: list[Processor] = [
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.format_exc_info,
    ]
    structlog.configure(
        processors=[*common, shown],
        logger_factory=structlog.WriteLoggerFactory(sys.stderr),  # a line is one write: others write there too
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    remove_meta = structlog.stdlib.ProcessorFormatter.remove_processors_meta
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[structlog.stdlib.add_logger_name, *common], processors=[remove_meta, shown]
        )
    )
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)
    logging.captureWarnings(True)
    sys.excepthook = _ended


def _ended(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    structlog.get_logger("process").critical("ended by an error", exc_info=(kind, error, trace))
