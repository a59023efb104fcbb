"""Errors of the Hugging Face Hub in words: what the Hub answered, and what the user can do about it.

``huggingface_hub`` raises its own errors, those of its HTTP client, and ``ValueError``, ``KeyError`` or
``TypeError`` for answers that it does not expect. All of them become errors of this project, and none of them
contains the token.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from huggingface_hub import constants, get_token
from huggingface_hub.errors import HfHubHTTPError

from rebar_depth_bench.base.errors import HubError, InputError, RebarDepthError, escape_text, exception_summary
from rebar_depth_bench.base.terminal import terminal_text

_OTHER_CHANGE = "no other change of the repository at the same time; run the command again"
_EXPECTED: Mapping[int, tuple[type[RebarDepthError], str]] = {
    400: (InputError, "content that the Hub accepts"),
    401: (InputError, "a valid token: hf auth login, or HF_TOKEN"),
    403: (InputError, "a token with permission to write to this repository, and room in the storage of its owner"),
    404: (InputError, "the id of a repository that exists, and that the token may see"),
    409: (HubError, _OTHER_CHANGE),
    412: (HubError, _OTHER_CHANGE),
    422: (InputError, "content that the Hub accepts"),
    429: (HubError, "fewer requests; run the command again later"),
}
"""Error and what is expected instead, by the HTTP status of an answer.

It is an ``InputError`` if the user's id, token or files cause the answer, not if it may be different later.
"""


def require_token() -> None:
    """Raise ``InputError`` unless a token is stored or given by the environment."""
    if not get_token():
        raise InputError("no token for the Hugging Face Hub, expected one: hf auth login, or HF_TOKEN")


def require_online() -> None:
    """Raise ``InputError`` if ``HF_HUB_OFFLINE`` is set."""
    if constants.HF_HUB_OFFLINE:
        raise InputError("HF_HUB_OFFLINE is set, expected a connection to the Hugging Face Hub: unset it")


@contextmanager
def hub_errors(action: str) -> Iterator[None]:
    """Convert the errors of ``huggingface_hub`` while it does ``action``, such as "org/name cannot be read".

    Raises ``InputError`` if the Hub refuses the user's id, token or files, ``HubError`` for anything else.
    Warnings are printed to standard error.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        warnings.simplefilter("ignore", DeprecationWarning)  # The client's calls are not the user's.
        try:
            yield
        except RebarDepthError:
            raise
        except Exception as error:  # The HTTP client's errors have no base class in the Hub's package.
            raise _converted(action, error) from None
    for warning in caught:
        print(terminal_text(_without_token(str(warning.message))), file=sys.stderr)


def _converted(action: str, error: Exception) -> RebarDepthError:
    """Return the error of this project for an error of ``huggingface_hub``."""
    place = f"{action}: the Hub at {constants.ENDPOINT}"
    causes = [error]
    while isinstance(earlier := causes[-1].__cause__, Exception) and earlier not in causes:
        causes.append(earlier)  # ``huggingface_hub`` wraps the errors of its threads.
    for cause in causes:
        if isinstance(cause, HfHubHTTPError):
            status, message = cause.response.status_code, cause.server_message
            words = f" ({escape_text(_without_token(str(message)))})" if message else ""  # the Hub's own
            error_type, expected = _EXPECTED.get(status, (HubError, "success"))
            return error_type(f"{place} answers with status {status}{words}, expected {expected}")
        if isinstance(cause, OSError) and cause.filename is not None:
            return InputError(f"{action}: {cause.filename} cannot be read: {cause.strerror or cause}")
    summary = escape_text(_without_token(exception_summary(causes[-1])))
    return HubError(f"{place} gives no usable answer: {summary}")


def _without_token(text: str) -> str:
    """Return text of a server without the token, which the server knows and could repeat."""
    token = get_token()
    return text.replace(token, "[token]") if token else text
