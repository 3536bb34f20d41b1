"""Tables of references: titles, units, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from knode_cosserat.cli.control import parsed_reference
from knode_cosserat.control.references import ReferenceFormatError


def read(folder, text):
    path = folder / "path.csv"
    path.write_text(text)
    return parsed_reference(str(path))


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y\n0,0,0\n2,0.03,0.01\n",
        "time,x,y,z\n0,0,0,\n2,0.03,0.01,\n",
        "time [s],x [mm],y [mm]\n0,0,0\n2,30,10\n",
        "y_mm, X (cm), error, t [ms]\n0,0,1,0\n10,3,1,2000\n",
        "t [s];x [m];y / mm\n0;0;0\n2;0,03;10\n",
    ],
)
def test_a_table_is_read_in_the_units_of_its_titles(tmp_path, text):
    assert_allclose(read(tmp_path, text).at([1.0, 2.0]), [[0.015, 0.005, np.nan], [0.03, 0.01, np.nan]])


def test_z_is_tracked_if_it_is_given(tmp_path):
    assert_allclose(read(tmp_path, "t,x,y,z [mm]\n0,0,0,20\n").at([0.0]), [[0.0, 0.0, 0.02]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,0\n", "has no column y; a reference has t or time, x, y and perhaps z"),
        ("0,0,0\n1,1,1\n", "has no column t"),
        ("t,x [furlong],y\n0,0,0\n", "'x \\[furlong\\]' has an unknown unit; allowed is m, cm, mm"),
        ("t [h],x,y\n0,0,0\n", "'t \\[h\\]' has an unknown unit; allowed is s, ms, us, ns"),
        ("t,time,x,y\n0,0,0,0\n", "has several columns for t; allowed is one"),
        ("t,x,y\ns,mm,mm\n0,0,0\n", "no numbers .s, mm, mm.; .* allowed is one line of titles"),
        ("t,x,y\n0,far,0\n", "row 1: x is 'far'; allowed is a finite number"),
        ("", "is empty; allowed is a table of t, x, y and perhaps z"),
    ],
)
def test_what_is_no_reference_is_told_in_one_line(tmp_path, text, message):
    with pytest.raises(ReferenceFormatError, match=message) as refused:
        read(tmp_path, text)
    assert "\n" not in str(refused.value)
