"""A page for browsers on this machine: the restored frames as motion JPEG, and the vibration as text."""

import html
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_HOST = "127.0.0.1"  # never reachable from other machines
_BOUNDARY = "rsvib-frame"
_PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>rsvib live</title>
<style>body{{font-family:sans-serif;margin:1em}}img{{max-width:100%}}pre{{background:#f4f4f4;padding:.6em}}</style>
</head><body><h1>rsvib live</h1><img src="/frames" alt="restored frames"><pre id="state">{state}</pre>
<script>setInterval(async () => {{document.getElementById("state").textContent =
await (await fetch("/state")).text()}}, 500)</script></body></html>"""


class PageOutput:
    """Restored frames at ``http://127.0.0.1:PORT``; the port 0 chooses a free one. ``url`` is the address."""

    def __init__(self, port: int) -> None:
        self._changed, self._frame, self._number, self._open = threading.Condition(), b"", 0, True
        self._viewers, self._state = 0, "waiting for frames"
        output = self

        class Handler(BaseHTTPRequestHandler):
            """Answers of the page."""

            timeout = 10.0  # s, without a byte; connections that are never used would keep a thread each

            def do_GET(self) -> None:
                """Answer a request."""
                if self.headers.get("Host", "").rpartition(":")[0] not in (_HOST, "localhost"):
                    self.send_error(403, f"the page is at {output.url}")  # another site refers to this machine
                elif self.path == "/frames":
                    output._send_frames(self)
                elif self.path in ("/", "/state"):
                    state = output._state
                    text = state if self.path == "/state" else _PAGE.format(state=html.escape(state))
                    kind = "text/plain" if self.path == "/state" else "text/html"
                    data = text.encode()
                    self.send_response(200)
                    self.send_header("Content-Type", f"{kind}; charset=utf-8")
                    self.send_header("Content-Length", str(len(data)))
                    self.end_headers()
                    self.wfile.write(data)
                else:
                    self.send_error(404)

            def log_message(self, *_: Any) -> None:
                """Requests are not printed."""

        try:
            self._server = ThreadingHTTPServer((_HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise OSError(f"--page {port}: {error}; choose another port") from error
        self._server.daemon_threads = True
        self.url = f"http://{_HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="rsvib-page", daemon=True)
        self._thread.start()

    def show_state(self, text: str) -> None:
        """Show a text below the frames."""
        self._state = text

    def write(self, frame: NDArray[np.uint8], index: int) -> None:
        """Show a frame; it is encoded if a browser shows the page."""
        if self._viewers == 0:
            return
        colours = frame if frame.ndim == 2 else np.ascontiguousarray(frame[..., ::-1])
        data = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
        with self._changed:
            self._frame, self._number = data, self._number + 1
            self._changed.notify_all()

    def _send_frames(self, request: BaseHTTPRequestHandler) -> None:
        """Send frames until the browser leaves; a slow browser gets fewer of them."""
        request.send_response(200)
        request.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        request.end_headers()
        self._viewers, sent = self._viewers + 1, 0
        try:
            while self._open:
                with self._changed:
                    while self._number == sent and self._open:
                        self._changed.wait(1.0)
                    data, sent = self._frame, self._number
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                request.wfile.write(head.encode() + data + b"\r\n")
        except OSError:
            pass  # the browser has left
        finally:
            self._viewers -= 1

    def close(self) -> None:
        """End the page."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
