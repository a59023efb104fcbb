"""Refusals that several operations share, for the OpenAPI document: by status, the model and when it comes."""

from __future__ import annotations

from typing import Any

from leaderboard.api.models import Problem, Problems

Answers = dict[int | str, dict[str, Any]]

AWAY: Answers = {503: {"model": Problem, "description": "the database does not answer; try again in a while"}}
ANY_TIME: Answers = {429: {"model": Problem, "description": "too many requests"}, **AWAY}
MALFORMED: Answers = {422: {"model": Problems, "description": "the request is malformed"}}
UNKNOWN_TOKEN: Answers = {401: {"model": Problem, "description": "an unknown token"}}
NO_TOKEN: Answers = {401: {"model": Problem, "description": "no token, or an unknown one"}}
