"""A session with its gallery, and a client of its server."""

import json
from contextlib import contextmanager

from app.cli.open_twin import FileOpener, open_session, opened_twin
from app.web.gallery.gallery import StartRequest
from app.web.session import Page
from tests.app.served import Client
from tests.waiting import wait_for


class Opened:
    """A session with its gallery, and requests of a browser."""

    def __init__(self, session):
        self.session = session
        self.client = Client(session.http_server)

    @property
    def engine(self):
        return self.session.engine

    def get(self, target):
        return json.loads(self.client.get(target).body)

    def post(self, target, body):
        answer = self.client.post(target, body)
        return answer.status, json.loads(answer.body)

    def state(self):
        return self.get("/api/session")

    def settled(self):
        wait_for(lambda: self.state()["starting"] is None)
        return self.state()

    def start(self, name):
        status, answer = self.post("/api/gallery/start", {"twin": name})
        assert status == 202, answer
        return self.settled()


@contextmanager
def opened(folder, twin=None, *, speed=1.0):
    """`nisus run [TWIN]`, as it would be started in a folder."""
    opening, wanted, opener = None, None, FileOpener()
    if twin is not None:

        def read():
            return opened_twin(str(twin), speed=speed)

        opening, wanted, opener = read(), StartRequest(str(twin)), FileOpener({str(twin): read})
    session = open_session(opening, wanted, opener, page=Page(0, open_browser=False), recordings=folder)
    session.start()
    try:
        yield Opened(session)
    finally:
        session.stop()
