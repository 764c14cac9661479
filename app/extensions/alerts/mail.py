"""Alerts by e-mail."""

from __future__ import annotations

import smtplib
import socket
import ssl
from email.message import EmailMessage
from pathlib import Path

from app.engine.outputs.alerts import AlertMessage
from app.engine.outputs.receivers import TIMEOUT_S
from app.twin.secrets import Secrets

from .schema import EmailSection
from .webhook import Deadline


class PlainMail(smtplib.SMTP):
    """Connection to a mail server, whose socket is added to a list as soon as it is connected."""

    sockets: list[socket.socket]

    def _get_socket(self, *args: object) -> socket.socket:
        sock: socket.socket = super()._get_socket(*args)  # type: ignore[misc]
        self.sockets.append(sock.dup())
        return sock


class SecureMail(smtplib.SMTP_SSL, PlainMail):
    """The same with TLS, whose handshake counts too."""


class Mail:
    """Sends alerts as e-mail."""

    def __init__(self, section: EmailSection, _folder: Path, secrets: Secrets) -> None:
        self._section = section
        self._password = None if section.password_env is None else secrets[section.password_env]

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        section, mail = self._section, EmailMessage()
        mail["Subject"] = f"[{alert.twin}] {alert.status}: {alert.rule}"
        mail["From"], mail["To"] = section.sender, ", ".join(section.to)
        lines = [alert.text, "", f"Since {alert.since}; health is {alert.health}.", f"Response: {alert.response}"]
        mail.set_content("\n".join([*lines, alert.link or alert.guide, "", alert.model_dump_json(indent=2)]))
        context, deadline = ssl.create_default_context(), Deadline()
        kind = SecureMail if section.security == "tls" else PlainMail
        given: dict[str, object] = {"context": context} if section.security == "tls" else {}
        # A class of its own for each mail: the constructor connects, so the list cannot be given afterwards.
        connected = type(kind.__name__, (kind,), {"sockets": deadline.sockets})
        try:
            with connected(section.server, section.port, timeout=TIMEOUT_S, **given) as server:
                if section.security == "starttls":
                    server.starttls(context=context)
                if section.user is not None and self._password is not None:
                    server.login(section.user, self._password)
                server.send_message(mail)
        except OSError as error:  # smtplib's own among them
            text = f"it has not answered within {TIMEOUT_S:g} s" if deadline.missed(error) else str(error)
            raise OSError(text) from None
        finally:
            deadline.end()
