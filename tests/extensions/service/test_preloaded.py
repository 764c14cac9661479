"""The fork server has loaded what the process of a twin needs before its page is there."""

import json

from tests.support import run_python
from tests.waiting import LIMIT_S

PROGRAM = """
import json, sys
from app.extensions.service import preloaded
from config.schema import TwinSection
complete, before = TwinSection.__pydantic_complete__, {*sys.modules}
from pathlib import Path
from app.cli.open_twin import FileOpener, open_session, opened_twin
from app.web.gallery.gallery import StartRequest
from app.web.session import Page
opener = FileOpener()
opening = opener.made_ready(opened_twin("motor_winding"))
session = open_session(opening, StartRequest("motor_winding"), opener, page=Page(0, False, overview="../../"),
                       recordings=Path(sys.argv[1]))
session.start()
print(json.dumps([complete, sorted({*sys.modules} - before)]))
session.stop()
"""


def test_a_twin_opens_without_further_libraries(tmp_path):
    complete, loaded = json.loads(run_python(PROGRAM, tmp_path, timeout=LIMIT_S).stdout.splitlines()[-1])
    assert complete
    assert [name for name in loaded if name.split(".")[0] in ("PIL", "app", "config", "imageio")] == []
