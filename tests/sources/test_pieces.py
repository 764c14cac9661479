"""What the queue compiles for a source is what the source runs: nothing is compiled when the first event waits."""

import pytest

from app.twin.twin import load_twin
from config.loader import shipped
from estimators.pieces import LOOP, Piece
from sources.can.signals import extract, extract_signature
from sources.mapping import emit, emit_signature
from sources.pieces import FRAMES, VALUES, function_of, is_made, make, needs, pieces_of
from tests.sources.can.can_tools import decoding, frame, sensor
from tests.sources.tables.test_table import HEADER, table, write
from tests.support import read_all


def test_frames_and_rows_run_what_the_pieces_are(tmp_path):
    decoder = decoding(tmp_path, [sensor(0, "ENGINE", "Temp")])
    assert len(decoder.decode(decoder.gather([frame(256, bytes(8))], [1]))) == 1
    assert len(decoder.decode(decoder.gather([frame(256, bytes(8))] * 3, [1, 2, 3]))) == 3
    assert len(read_all(table(write(tmp_path, HEADER + "0.1,20,1,2,1,3,7\n")))) == 4
    for kernel, signature, name in ((extract, extract_signature, FRAMES), (emit, emit_signature, VALUES)):
        assert list(kernel.overloads) == [signature.args]
        (piece,) = pieces_of(name)
        assert function_of(piece) == (kernel, signature.args) and is_made(piece)
        make(piece)


def test_a_source_needs_its_kernel_alone_and_a_filter_the_loop():
    assert needs(FRAMES) == (FRAMES,) and needs("ekf") == (LOOP, "ekf")
    assert function_of(Piece("ekf", 1))[0].__name__ == "predict"


@pytest.mark.parametrize("name", shipped())
def test_every_twin_says_what_its_source_compiles(name):
    twin = load_twin(name)
    kind = twin.config.source.type
    assert twin.kernels == {"simulator": (), "table": (VALUES,)}.get(kind, (FRAMES, VALUES))
