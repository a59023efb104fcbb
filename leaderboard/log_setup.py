"""Structured logging on standard error: one JSON object per line, or readable lines on a terminal."""

from __future__ import annotations

import logging
import sys
from types import TracebackType

import structlog
from structlog.typing import Processor


def set_up_logs() -> None:
    """Configure logging of this process: structlog, library loggers, warnings and uncaught exceptions."""
    renderer: Processor = (
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
        processors=[*common, renderer],
        # Each line is a single write, because other processes write to the same stream.
        logger_factory=structlog.WriteLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    remove_meta = structlog.stdlib.ProcessorFormatter.remove_processors_meta
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[structlog.stdlib.add_logger_name, *common], processors=[remove_meta, renderer]
        )
    )
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)
    logging.captureWarnings(True)
    sys.excepthook = _log_uncaught_exception


def _log_uncaught_exception(
    error_type: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    structlog.get_logger("process").critical("uncaught exception", exc_info=(error_type, error, traceback))
