"""An archive of pumps whose rows the tests put."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from app.extensions.archive.parts import ArchivePlan, parts_of
from app.extensions.fleet.archive import FleetArchive
from app.extensions.fleet.journal import read_journal
from app.record.rrd_file import parse_split
from app.twin.twin import load_twin
from estimators.log import READING, Events

BEGIN, SECOND = 1_767_225_600 * 10**9, 10**9
SPLIT = parse_split("64MB,1h,day", None, "--archive")


class Written:
    """An archive of one sensor without a thread."""

    def __init__(self, folder, split=SPLIT):
        self.model, self.said, self.names = load_twin("motor_winding").model, [], [f"pump {k}" for k in range(5)]
        self.folder = folder / "pumps"
        self.archive = FleetArchive(
            ArchivePlan(self.folder, split), self.model, self.names, lambda _, text: self.said.append(text)
        )

    def put(self, first, count=10):
        """Put rows at consecutive seconds, whose value is their number."""
        number = np.arange(first, first + count)
        t = BEGIN + number * SECOND
        self.archive.append(number % 5, Events.alike(READING, t, number.astype(float)))
        self.archive.write()
        return self

    def values(self):
        """The values in the archive, those of its journals included."""
        tables = [pq.read_table(path) for path in parts_of(self.folder)]
        tables += filter(None, map(read_journal, self.folder.glob("*.arrows")))
        return sorted(pa.concat_tables(tables)["value_0"].to_pylist())
