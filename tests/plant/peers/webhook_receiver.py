"""A receiver of webhooks: prints each request as a line of JSON, with the verdict of the library of Standard Webhooks.

It answers 200. The line {"answers": [503, 302, ...]} on its input sets the next answers; 0 closes the connection without one. A redirection
leads to /elsewhere.

    webhook_receiver.py PORT SECRET
"""

import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from standardwebhooks.webhooks import Webhook, WebhookVerificationError

printing = threading.Lock()
answers = []


def say(**fields):
    with printing:
        print(json.dumps(fields), flush=True)


class Receiver(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self):
        body = self.rfile.read(int(self.headers["content-length"]))
        headers = {name.lower(): value for name, value in self.headers.items()}
        try:
            Webhook(sys.argv[2]).verify(body, headers)
            verified = True
        except WebhookVerificationError:
            verified = False
        answer = answers.pop(0) if answers else 200
        say(path=self.path, headers=headers, verified=verified, body=json.loads(body), answer=answer)
        if answer == 0:
            self.close_connection = True
            return
        self.send_response(answer)
        if 300 <= answer < 400:
            self.send_header("location", "/elsewhere")
        self.send_header("content-length", "0")
        self.end_headers()

    def do_GET(self):
        say(path=self.path, method="GET")
        self.send_error(405)

    def log_message(self, *_):
        pass


server = ThreadingHTTPServer(("127.0.0.1", int(sys.argv[1])), Receiver)
server.daemon_threads = True
threading.Thread(target=server.serve_forever, daemon=True).start()
say(listens=server.server_address[1])
for line in sys.stdin:
    answers.extend(json.loads(line)["answers"])
    say(answers=answers)
