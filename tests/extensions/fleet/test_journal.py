"""A journal is completed once, up to the last whole batch, by the process that has the folder."""

from itertools import pairwise

from app.extensions.archive.parts import parts_of
from app.extensions.fleet import journal as archive_journal
from app.extensions.fleet.archive import AssetHistory
from tests.extensions.fleet.written_archive import Written


def test_a_journal_of_a_killed_process_is_completed_up_to_its_last_whole_batch(tmp_path):
    written = Written(tmp_path).put(0).put(10).put(20)
    (journal,) = written.folder.glob("*.arrows")
    content = journal.read_bytes()
    written.archive._journal._file.close()
    sizes = []
    for end in range(0, len(content), 37):
        journal.write_bytes(content[:end])
        table = archive_journal.read_journal(journal)
        sizes.append(0 if table is None else table.num_rows)
    assert set(sizes) == {0, 10, 20} and all(one <= two for one, two in pairwise(sizes))
    again = Written(tmp_path).put(30)
    assert again.values() == [*map(float, range(20)), *map(float, range(30, 40))]
    assert again.said == [] and len(parts_of(again.folder)) == 1
    (part,) = parts_of(again.folder)
    journal.write_bytes(content)  # killed after the file was complete, and before its journal was removed
    again.archive._journal.close()
    assert AssetHistory(again.folder, "pump 3").read(100)["value_0"].to_pylist() == [3.0, 8.0, 13.0, 18.0, 33.0, 38.0]
    archive_journal.complete_journals(again.folder)
    assert len(parts_of(again.folder)) == 2 and part.exists() and len(again.values()) == 30


def test_two_processes_do_not_write_into_one_folder(tmp_path):
    first = Written(tmp_path).put(0)
    second = Written(tmp_path).put(10)
    assert "another process writes into it" in second.said[0]
    first.archive.write(closing=True)
    assert second.put(20).values() == [*map(float, range(30))]


def test_a_journal_that_begins_while_another_is_completed_has_a_number_of_its_own(tmp_path, monkeypatch):
    """Of two files of one number, the second would be removed as complete."""
    written = Written(tmp_path).put(0)
    written.archive._end()
    ended = written.archive._ended

    def meanwhile(folder):
        found = parts_of(folder)
        if ended:
            archive_journal.complete_journal(ended.pop())
        return found

    with monkeypatch.context() as patch:
        patch.setattr(archive_journal, "parts_of", meanwhile)
        written.put(10)
    written.archive.write(closing=True)
    assert written.said == [] and written.values() == [*map(float, range(20))]
