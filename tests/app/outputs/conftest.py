from tests.app.web.conftest import serve

__all__ = ["serve"]
