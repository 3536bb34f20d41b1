"""A small share of `make attack`: kills, disk faults and extreme robots; the rest in the campaign."""

import os
import time

import pytest

from knode_cosserat._files.writing import ABANDONED, replacing, temporary_folder
from tools.attack.cases import MOST_OFF, MOST_RESIDUAL, checked, drawn
from tools.attack.disk import faults
from tools.attack.kills import killed, killed_writes
from tools.attack.samples import samples

pytest.importorskip("pyarrow")


def failures(rows):
    return [failure for row in rows for failure in row.failures]


def test_every_sample_is_read_as_it_was_written(tmp_path):
    from tools.attack.samples import fingerprint

    for name, sample in samples().items():
        found = set()
        for version in (0, 1, 0):
            sample.write(tmp_path / name, version)
            found.add(fingerprint(sample.read(tmp_path / name)))
        # two versions that differ, and the same again for the same version
        assert len(found) == 2, name


@pytest.mark.slow
@pytest.mark.parametrize(
    "names", [("trajectory.nc", "figure.png", "bag.db3"), pytest.param((), marks=pytest.mark.campaign)]
)
def test_a_full_disk_leaves_all_files_as_they_were(names, tmp_path):
    count = len(names or samples())
    rows = faults(tmp_path, count, seed=1, names=names)
    assert failures(rows) == [] and sum(row.tried for row in rows) == count


@pytest.mark.slow
def test_killed_writes_leave_a_whole_file(tmp_path):
    row = killed_writes("bag.db3", tmp_path, 2, seed=1)
    assert row.failures == [] and row.tried == 2


def test_a_folder_of_a_killed_write_is_removed(tmp_path):
    with temporary_folder(tmp_path / "it.db3") as young:
        old = tmp_path / ".it.db3.0123456789ab.tmp"
        (old / "bag").mkdir(parents=True)
        before = time.time() - ABANDONED - 10.0
        os.utime(old, (before, before))
        with replacing(tmp_path / "it.db3") as temporary:
            temporary.write_text("new")
        assert young.exists() and not old.exists()
    assert [each.name for each in tmp_path.iterdir()] == ["it.db3"]


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [(1, 5, 9, 17), pytest.param(range(600), marks=pytest.mark.campaign)])
def test_converged_rows_agree_with_an_independent_residual_and_a_finer_grid(seeds):
    for seed in seeds:
        found = checked(drawn(seed))
        assert found.residual <= MOST_RESIDUAL and found.off <= MOST_OFF, seed


@pytest.mark.campaign
def test_thirty_kills_and_fifty_faults(tmp_path):
    (tmp_path / "kills").mkdir()
    (tmp_path / "disk").mkdir()
    assert failures(killed(tmp_path / "kills", 30, seed=2)) == []
    assert failures(faults(tmp_path / "disk", 50, seed=2)) == []


@pytest.mark.campaign
def test_the_owner_of_a_live_page_is_answered_during_a_flood():
    pytest.importorskip("websockets")
    from tools.attack.flood import flooded

    assert failures(flooded(20.0)) == []


def test_without_names_the_usual_parts_run(monkeypatch, capsys):
    from tools.attack import __main__ as command

    ran = []
    for name in command.PARTS:
        monkeypatch.setitem(command.PARTS, name, lambda *_given, name=name: ran.append(name) or [])
    with pytest.raises(SystemExit) as ended:
        command.main([])
    assert (ended.value.code, ran) == (0, list(command.USUAL))
    with pytest.raises(SystemExit):
        command.main(["flod"])
    assert "unknown part 'flod'" in capsys.readouterr().err
