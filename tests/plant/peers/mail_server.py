"""A mail server on aiosmtpd: prints each mail as a line of JSON. It takes no mail before STARTTLS and the right password.

    mail_server.py CERTIFICATE KEY USER PASSWORD
"""

import asyncio
import email
import json
import ssl
import sys
from email import policy

from aiosmtpd.smtp import SMTP, AuthResult

certificate, key, user, password = sys.argv[1:]


def say(**fields):
    print(json.dumps(fields), flush=True)


class Printer:
    async def handle_DATA(self, server, session, envelope):
        message = email.message_from_bytes(envelope.content, policy=policy.default)
        say(
            encrypted=session.ssl is not None,
            authenticated=session.authenticated,
            sender=envelope.mail_from,
            receivers=envelope.rcpt_tos,
            headers=dict(message.items()),
            body=message.get_content(),
        )
        return "250 taken"


def authenticated(server, session, envelope, mechanism, data):
    right = (data.login.decode(), data.password.decode()) == (user, password)
    if not right:
        say(refused=data.login.decode())
    return AuthResult(success=right)


context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
context.load_cert_chain(certificate, key)


async def serve():
    loop = asyncio.get_running_loop()
    settings = {
        "tls_context": context,
        "require_starttls": True,
        "authenticator": authenticated,
        "auth_required": True,
        "loop": loop,
    }
    server = await loop.create_server(lambda: SMTP(Printer(), **settings), "127.0.0.1", 0)
    say(listens=server.sockets[0].getsockname()[1])
    await loop.run_in_executor(None, sys.stdin.read)


asyncio.run(serve())
