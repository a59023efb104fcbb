"""Refusals that arrive: a client that is still sending when its upload is refused would see a cut connection."""

from __future__ import annotations

from anyio import move_on_after
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SILENCE_S = 5.0
MOST_S = 600.0


class Drain:
    """ASGI middleware. Before a refusal is sent, what the client still sends is read, ``most`` bytes of it.

    A client that falls silent, be it that it never sends what it has announced, is told after ``SILENCE_S``.
    """

    def __init__(self, app: ASGIApp, *, most: int) -> None:
        self._app, self._most = app, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # A client that waits for 100 Continue has sent nothing yet, and sends nothing once it is refused.
        is_sending = "expect" not in Headers(scope=scope)
        more = True

        async def receive_watched() -> Message:
            nonlocal is_sending, more
            message = await receive()
            is_sending = True
            more = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def send_after(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] >= 400:
                left = self._most
                with move_on_after(MOST_S):
                    while more and is_sending and left > 0:
                        with move_on_after(SILENCE_S) as silence:
                            left -= len((await receive_watched()).get("body", b""))
                        if silence.cancelled_caught:
                            break
            await send(message)

        await self._app(scope, receive_watched, send_after)
