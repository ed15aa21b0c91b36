"""Campaigns: which files are read, under which settings, and that none outside is touched."""

from __future__ import annotations

import os

import pytest

from servolens.campaign import read_records
from servolens.errors import InputError

PLAIN = "# kp = 60\ntime,position,reference\n0,0,0.1\n0.001,0,0.1\n"
SECRET = "# kp = s3cret\ntime,position,reference\n0,s3cret,0.1\n"


@pytest.fixture
def folder(tmp_path):
    """A campaign's folder with three runs, beside a file that is not the campaign's."""
    made = tmp_path / "axis"
    made.mkdir()
    for name in ("b.csv", "a.csv", "c.CSV"):
        (made / name).write_text(PLAIN)
    (made / ".hidden.csv").write_text("junk")
    (made / "notes.txt").write_text("junk")
    (tmp_path / "secret.csv").write_text(SECRET)
    return made


def campaign(folder, text):
    path = folder / "campaign.toml"
    path.write_text(text)
    return path


def refusal(*args, **options):
    with pytest.raises(InputError) as refused:
        read_records(*args, **options)
    message = str(refused.value)
    assert message.isprintable()
    assert "s3cret" not in message
    return message


def test_files_are_read_in_the_order_given(folder):
    records = read_records([folder / "b.csv", str(folder / "a.csv")])
    assert [record.name for record in records] == ["b", "a"]


def test_one_path_need_not_stand_in_a_list(folder):
    assert len(read_records(folder / "a.csv")) == 1
    assert len(read_records(str(folder / "a.csv"))) == 1


def test_folder_gives_its_records_by_name(folder):
    assert [record.name for record in read_records(folder)] == ["a", "b", "c"]


def test_campaign_gives_each_entry_its_settings(folder):
    (folder / "run.csv").write_text("t_ms,qm,vir\n0,0,1\n1,5,2\n")
    path = campaign(
        folder,
        "[defaults]\nkd = 2\nencoder_resolution = '10 um'\n"
        "[[records]]\nfile = 'a.csv'\nkp = 80\nname = 'first'\n"
        "[[records]]\nfile = 'run.csv'\nkp = '0.1 V/mm'\n"
        "columns = {time = 't_ms', position = 'qm', voltage = 'vir'}\nunits = {time = 'ms', position = 'mm'}\n",
    )
    first, second = read_records(path)
    assert (first.name, first.controller.kp, first.controller.kd) == ("first", 80, 2)
    assert (second.controller.kp, second.encoder_resolution) == (pytest.approx(100), pytest.approx(1e-5))
    assert second.time.tolist() == [0, 0.001]
    assert second.position == pytest.approx([0, 0.005])


def test_caller_wins_over_the_campaign(folder):
    path = campaign(folder, "[[records]]\nfile = 'a.csv'\nkp = 80\n[[records]]\nfile = 'b.csv'\n")
    records = read_records(path, settings={"kp": 90, "kd": None})
    assert [record.controller.kp for record in records] == [90, 90]


def test_defaults_hold_columns_that_entries_extend(folder):
    (folder / "run.csv").write_text("time,qm,vir\n0,0,1\n1,5,2\n")
    path = campaign(
        folder,
        "[defaults]\ncolumns = {position = 'qm'}\n[[records]]\nfile = 'run.csv'\ncolumns = {voltage = 'vir'}\n",
    )
    (record,) = read_records(path)
    assert record.voltage.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty; check how it was written"),
        ("# nothing", "holds no [[records]] entries; write one for each file"),
        ("records = []", "holds no [[records]] entries; write one for each file"),
        ("records = [1]", "holds no [[records]] entries; write one for each file"),
        ("[records]\nfile = 'a.csv'", "holds no [[records]] entries; write one for each file"),
        ("kp = 60\n[[records]]\nfile = 'a.csv'", "the campaign has a key 'kp'; known are records, defaults"),
        ("defaults = 3\n[[records]]\nfile = 'a.csv'", "defaults must be a table of keys and values"),
        ("a = ", "is not valid TOML: 'Invalid value (at end of document)'"),
        ("a = " + "[" * 5000, "is not valid TOML: nested too deep, or a number too long"),
        ("[[records]]\nkp = 3", "records[0]: file is missing; name the record's file, relative to the TOML"),
        ("[[records]]\nfile = 3", "records[0]: file is missing; name the record's file, relative to the TOML"),
        (
            "[[records]]\nfile = 'a.csv'\n[[records]]\nfile = 'no.csv'",
            "records[1] (no.csv): cannot be opened: no such file or directory",
        ),
        (
            "[[records]]\nfile = 'other.toml'",
            "records[0] (other.toml): is a campaign, not a record; write its entries here, one for each record",
        ),
        (
            "[[records]]\nfile = 'a.csv'\nkp = 'x'",
            "records[0] (a.csv): kp must be a number, perhaps with a unit; 'x' is not a number",
        ),
        (
            "[[records]]\nfile = 'a.csv'\ncolumns = 3",
            "records[0] (a.csv): columns must be a table such as {position = 'qm'}",
        ),
        (
            "[[records]]\nfile = 'a.csv'\n[[records]]\nfile = './a.csv'",
            "records[1] (./a.csv): the same file is given twice, first as {path}: records[0] (a.csv)",
        ),
    ],
)
def test_refusal_names_campaign_and_entry(folder, text, sentence):
    path = campaign(folder, text)
    expected = sentence.replace("{path}", str(path))
    assert refusal(path) == f"{path}: {expected}"


def test_unknown_key_of_an_entry_names_the_known_ones(folder):
    path = campaign(folder, "[[records]]\nfile = 'a.csv'\ngain = 3")
    assert refusal(path).startswith(
        f"{path}: records[0] (a.csv): the entry has a key 'gain'; known are file, name, kp,"
    )


@pytest.mark.parametrize("file", ["../secret.csv", "x/../../secret.csv", "link.csv", "linked/secret.csv", "{outside}"])
def test_campaign_does_not_leave_its_folder(folder, file):
    (folder / "link.csv").symlink_to(folder.parent / "secret.csv")
    (folder / "linked").symlink_to(folder.parent)
    file = file.replace("{outside}", str(folder.parent / "secret.csv"))
    path = campaign(folder, f"[[records]]\nfile = '{file}'\n")
    message = refusal(path)
    assert message.startswith(f"{path}: records[0] (")
    assert message.endswith("): the file lies outside its folder; name a data root (--data-root) that holds it")


def test_loop_of_links_is_refused(folder):
    (folder / "x.csv").symlink_to(folder / "x.csv")
    path = campaign(folder, "[[records]]\nfile = 'x.csv'\n")
    assert refusal(path).startswith(f"{path}: records[0] (x.csv): ")


def test_folder_does_not_follow_links_outside(folder):
    (folder / "link.csv").symlink_to(folder.parent / "secret.csv")
    assert refusal(folder) == (
        f"{folder / 'link.csv'}: the file lies outside its folder; name a data root (--data-root) that holds it"
    )


def test_data_root_opens_what_lies_below_it_and_nothing_else(folder, tmp_path_factory):
    (folder.parent / "other.csv").write_text(PLAIN)
    path = campaign(folder, "[[records]]\nfile = '../other.csv'\n")
    assert len(read_records(path, data_root=folder.parent)) == 1
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    assert refusal(path, data_root=elsewhere).endswith(
        "the file lies outside the data root; name a data root (--data-root) that holds it"
    )


@pytest.mark.parametrize("root", ["missing", "a.csv"])
def test_data_root_that_is_no_folder_is_refused_as_such(folder, root):
    path = campaign(folder, "[[records]]\nfile = 'a.csv'\n")
    assert refusal(path, data_root=folder / root) == (
        f"{folder / root}: is no folder; the data root (--data-root) must be one"
    )


def test_link_to_itself_is_refused_by_its_name(folder):
    link = folder / "link.csv"
    link.symlink_to(link)
    assert refusal(link) == f"{link}: cannot be opened: too many levels of symbolic links"


def test_entry_with_control_characters_is_escaped(folder):
    path = campaign(folder, '[[records]]\nfile = "a\\u001b[31m\\n.csv"\n')
    assert refusal(path).startswith(f"{path}: records[0] (a\\x1b[31m\\n.csv): ")


def test_same_file_twice_is_refused(folder):
    os.link(folder / "a.csv", folder / "hard.csv")
    for other in (folder / "a.csv", folder / "hard.csv"):
        assert refusal([folder / "a.csv", other]) == (
            f"{other}: the same file is given twice, first as {folder / 'a.csv'}"
        )


def test_same_file_twice_is_refused_also_by_the_same_short_name(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert refusal(["a.csv", "a.csv"]) == "a.csv: the same file is given twice, first as a.csv"


def test_metres_and_radians_together_are_refused(folder):
    (folder / "b.csv").write_text(PLAIN.replace("position", "position [rad]"))
    assert refusal([folder / "a.csv", folder / "b.csv"]) == (
        f"{folder / 'b.csv'}: position is in rad, in {folder / 'a.csv'} in m; records of one axis have the same units"
    )


def test_different_commands_together_are_refused(folder):
    (folder / "b.csv").write_text(PLAIN.replace("kp = 60", "kp = 60 A/m"))
    assert refusal([folder / "a.csv", folder / "b.csv"]) == (
        f"{folder / 'b.csv'}: the command is in A, in {folder / 'a.csv'} in V; records of one axis have the same units"
    )


def test_nothing_to_read_is_said(folder, tmp_path):
    assert refusal([]) == "no records are given; name files, folders or a campaign TOML"
    empty = tmp_path / "empty"
    empty.mkdir()
    assert refusal(empty) == f"{empty}: is a folder without logs such as .csv, .mat or .xlsx"
    (empty / "run4.txt").write_text("millis\tpos\n")
    assert refusal(empty).endswith(f"; if a text in it is a log, name that file: {empty / 'run4.txt'}")
    assert refusal(tmp_path / "no.toml") == f"{tmp_path / 'no.toml'}: cannot be opened: no such file or directory"


def test_large_campaign_is_refused(folder):
    path = campaign(folder, "#" * (2**20 + 1))
    assert refusal(path) == f"{path}: has 1 MiB; files up to 1 MiB are read"
