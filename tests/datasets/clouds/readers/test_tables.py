"""Tables in the dialects of other programs: the same points, normals and colours of 8 bits, far from the origin."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mplicits.datasets import read_cloud
from mplicits.datasets.clouds.point_cloud import colors_from, unit_rows
from mplicits.datasets.clouds.readers.columns import sampled
from mplicits.datasets.clouds.readers.reading import open_stream
from mplicits.neural_fields import InputError
from refusals import refused

COUNT = 40
RANDOM = np.random.default_rng(0)
N = unit_rows(RANDOM.normal(size=(COUNT, 3)))
P = (2 * N + [431234.5, 5412345.6, 250.0]).round(6)
C = RANDOM.integers(0, 256, (COUNT, 3))
I = RANDOM.integers(-2048, 2048, (COUNT, 1))  # noqa: E741 (intensity)
ONE, NO = np.full((COUNT, 1), 255), np.zeros((COUNT, 3))
RGB16 = C * 257


def table(*columns, sep=" ", decimal="."):
    rows = np.concatenate(columns, axis=1)
    return "".join(sep.join(f"{x:.15g}".replace(".", decimal) for x in row) + "\n" for row in rows)


# name of the file, what stands in it, and which of normals and colours are read of it
TEXTS = {
    "positions": ("a.xyz", table(P), ""),
    "commas": ("a.csv", table(P, N, sep=","), "n"),
    "commas and spaces": ("a.txt", table(P, N, C, sep=", "), "nc"),
    "tabs": ("a.txt", table(P, N, C, sep="\t"), "nc"),
    "wide spaces": ("a.asc", table(P, N, sep="   "), "n"),
    "semicolons and decimal commas": ("a.csv", table(P, N, sep=";", decimal=","), "n"),
    "tabs and decimal commas": ("a.txt", table(P, N, sep="\t", decimal=","), "n"),
    "separators at the ends": ("a.csv", table(P, sep=",").replace("\n", ",\n"), ""),
    "CR LF": ("a.txt", table(P, N).replace("\n", "\r\n"), "n"),
    "CR": ("a.txt", table(P, N).replace("\n", "\r"), "n"),
    "byte-order mark": ("a.csv", "\ufeffx,y,z\n" + table(P, sep=","), ""),
    "comments around": ("a.txt", "# made today\n\n" + table(P, N) + "\n# end\n", "n"),
    "title": ("a.txt", "My scan\n" + table(P, N), "n"),
    "colours before normals": ("a.txt", table(P, C, N), "nc"),
    "colours": ("a.xyz", table(P, C), "c"),
    "colours of 16 bits": ("a.txt", table(P, RGB16), "c"),
    "colours up to 1": ("a.txt", table(P, C / 255), "c"),
    "normals and fractions": ("a.txt", table(P, N, C / 255), "nc"),
    "zeros for normals": ("a.txt", table(P, NO, C), "c"),
    "intensity": ("a.txt", table(P, I), ""),
    "intensity, colours": ("a.txt", table(P, I, C), "c"),
    "colours, fraction": ("a.txt", table(P, C, I / 5000), "c"),
    "colours, opacity": ("a.txt", table(P, C, ONE), "c"),
    "intensity, normals": ("a.txt", table(P, I, N), "n"),
    "normals, colours, intensity": ("a.txt", table(P, N, C, I), "nc"),
    "PTS": ("a.pts", f"{COUNT}\n" + table(P, I, C), "c"),
    "PTS, intensity like a colour": ("a.pts", f"{COUNT}\n" + table(P, C[:, :1], C), "c"),
    "PTS of two scans": ("a.pts", f"{COUNT // 2}\n" + table(P[:20], C[:20]) + f"20\n{table(P[20:], C[20:])}", "c"),
    "CloudCompare": ("a.txt", "//X Y Z R G B Nx Ny Nz\n" + table(P, C, N), "nc"),
    "CloudCompare, count": ("a.txt", f"//X Y Z R G B Nx Ny Nz\n{COUNT}\n" + table(P, C, N), "nc"),
    "NumPy": ("a.txt", "# x y z r g b nx ny nz\n" + table(P, C, N), "nc"),
    "semicolon mark": ("a.txt", "; x y z nx ny nz\n" + table(P, N), "n"),
    "columns: in a comment": ("a.txt", "# columns: x y z nx ny nz\n" + table(P, N), "n"),
    "PDAL": ("a.csv", '"X","Y","Z","NormalX","NormalY","NormalZ"\n' + table(P, N, sep=","), "n"),
    "UTF-16": ("a.csv", '"X","Y","Z"\n' + table(P, sep=","), ""),
    "PDAL, colours": ("a.csv", '"X","Y","Z","Red","Green","Blue"\n' + table(P, RGB16, sep=","), "c"),
    "names of two words": ("a.csv", "x,y,z,cloud distance,Normal X,Normal Y,Normal Z\n" + table(P, I, N, sep=","), "n"),
    "quoted words between spaces": ("a.txt", 'x y z "cloud distance"\n' + table(P, I), ""),
    "units": ("a.csv", "X [m],Y [m],Z [m]\n" + table(P, sep=","), ""),
    "units and intensity": ("a.txt", "X(m) Y(m) Z(m) Intensity\n" + table(P, I), ""),
    "units, spaces": ("a.txt", "X [m] Y [m] Z [m] N_x N_y N_z\n" + table(P, N), "n"),
    "other order": ("a.csv", "blue;green;red;id;z;y;x\n" + table(C[:, ::-1], I, P[:, ::-1], sep=";"), "c"),
    "survey": ("a.csv", "Easting,Northing,Elevation\n" + table(P, sep=","), ""),
    "suffixes": ("a.txt", "x y z red_8 green_8 blue_8\n" + table(P, C), "c"),
    "underscores": ("a.txt", "pos_x pos_y pos_z normal_x normal_y normal_z diffuse_red diffuse_green diffuse_blue\n"
                    + table(P, N, C), "nc"),
    "CloudCompare, fractions": ("a.txt", "//X Y Z Rf Gf Bf Nx Ny Nz\n" + table(P, C / 255, N), "nc"),
    "ParaView": ("a.csv", '"Normals:0","Normals:1","Normals:2","Points:0","Points:1","Points:2"\n'
                 + table(N, P, sep=","), "n"),
    "empty fields": ("a.csv", "z,i,y,x\n" + "".join(f"{z},,{y},{x}\n" for x, y, z in P), ""),
    "empty fields at the ends": ("a.csv", "id,z,y,x,i\n" + "".join(f",{z}, {y},{x},\n" for x, y, z in P), ""),
    "some empty fields": ("a.csv", "x,y,z,i\n" + "".join(f"{x},{y},{z},{'' if y % 2 else 7}\n" for x, y, z in P), ""),
    "quoted numbers": ("a.csv", "".join(f'"{x}","{y}","{z}"\n' for x, y, z in P), ""),
}  # fmt: skip


def check(path, expected, **options):
    cloud = read_cloud(path, **options)
    assert np.allclose(cloud.points, P, atol=1e-6, rtol=0)
    for letter, read, wanted in (("n", cloud.normals, N), ("c", cloud.colors, C / 255)):
        assert (read is not None) == (letter in expected)
        assert read is None or np.allclose(read, wanted, atol=2e-3)
    assert cloud.reading.startswith(f"{COUNT} points")
    return cloud


@pytest.mark.parametrize("name", TEXTS)
def test_text(tmp_path, name):
    file, text, expected = TEXTS[name]
    (tmp_path / file).write_bytes(text.encode("utf-16" if name == "UTF-16" else "utf-8"))
    check(tmp_path / file, expected)


@pytest.mark.parametrize(
    "columns",
    [
        (P, I, I),  # two numbers without a name
        (P, C, C[:, :1]),  # intensity before or after the colours
        (P, 3 * N),  # neither of unit length nor colours
        (P, N, 300 * N),
        (np.arange(COUNT)[:, None], P),  # the first one counts
        (np.arange(COUNT)[:, None], P, N),
    ],
)
def test_what_values_do_not_tell_is_refused_until_it_is_named(tmp_path, columns):
    (tmp_path / "a.txt").write_text(table(*columns))
    np.save(tmp_path / "a.npy", np.concatenate(columns, axis=1))
    for name in ("a.txt", "a.npy"):
        with pytest.raises(InputError, match=r"columns.*--columns x,y,z,"):
            read_cloud(tmp_path / name)
    wide = sum(np.shape(part)[1] for part in columns)
    first = ["-"] * (columns[0] is not P) + ["x", "y", "z"]
    given = ",".join(first + ["-"] * (wide - len(first)))
    for name in ("a.txt", "a.npy"):
        assert "ignored" in check(tmp_path / name, "", columns=given).reading


def test_requested_columns_come_before_names(tmp_path):
    (tmp_path / "a.txt").write_text("x y z r g b\n" + table(P, N))
    check(tmp_path / "a.txt", "n", columns="x,y,z,nx,ny,nz")
    (tmp_path / "a.off").write_text("OFF\n")
    for name, columns in (("a.txt", "x,y,z,-"), ("a.txt", "x,y"), ("a.off", "x,y,z")):
        with pytest.raises(InputError, match="columns"):
            read_cloud(tmp_path / name, columns=columns)


NAMES = {
    "lower": ("x y z", "nx ny nz", "red green blue"),
    "upper": ("X Y Z", "NX NY NZ", "Red Green Blue"),
    "words": ("x y z", "normal_x normal_y normal_z", "diffuse_red diffuse_green diffuse_blue"),
    "short": ("px py pz", "NormalX NormalY NormalZ", "r g b"),
}


@pytest.mark.parametrize("names", NAMES.values(), ids=list(NAMES))
@pytest.mark.parametrize("encoding", ["ascii", "ascii, CR", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("shades", ["uchar", "ushort", "float"])
def test_ply(tmp_path, names, encoding, shades):
    order = ">" if "big" in encoding else "<"
    kinds = [("double", "f8"), ("float", "f4"), (shades, {"uchar": "u1", "ushort": "u2", "float": "f4"}[shades])]
    row = [(name, order + kind[1]) for triple, kind in zip(names, kinds, strict=True) for name in triple.split()]
    rows = np.zeros(COUNT, [*row, ("quality", order + "f4")])
    values = np.hstack((P, N, {"uchar": C, "ushort": RGB16, "float": C / 255}[shades]))
    for (name, _), column in zip(row, values.T, strict=True):
        rows[name] = column
    types = {form: word for word, form in kinds}
    lines = [f"property {types[kind[1:]]} {name}" for name, kind in row]
    head = f"ply\nformat {encoding.split(',')[0]} 1.0\nelement vertex {COUNT}\n" + "\n".join(lines)
    head += "\nproperty float quality\nend_header\n"
    body = table(values, np.zeros((COUNT, 1))).encode() if "ascii" in encoding else rows.tobytes()
    data = head.encode() + body
    (tmp_path / "a.ply").write_bytes(data.replace(b"\n", b"\r") if "CR" in encoding else data)
    assert "ignored: quality" in check(tmp_path / "a.ply", "nc").reading
    stream = open_stream(tmp_path / "a.ply")
    assert (stream is None) == ("ascii" in encoding)
    if stream is not None:
        points, normals, colors = (np.concatenate(parts) for parts in zip(*stream.pieces(7), strict=True))
        np.testing.assert_allclose(np.hstack((points, normals, colors_from(colors))), np.hstack((P, N, C / 255)), 1e-5)


def lzf(data):
    """Pack by LZF: repeats of 3 to 8 bytes are looked for at each place; the rest is not packed."""
    out, plain, at = bytearray(), bytearray(), 0
    while at <= len(data):
        start, length = data.rfind(data[at : at + 3], max(0, at - 8000), at + 2) if at + 3 <= len(data) else -1, 3
        if 0 <= start < at or at == len(data) or len(plain) == 32:
            out += bytes([len(plain) - 1] if plain else []) + plain
            plain.clear()
        if at == len(data):
            break
        if 0 <= start < at:
            while length < 8 and at + length < len(data) and data[start + length] == data[at + length]:
                length += 1
            away = at - start - 1
            out += bytes([(length - 2) << 5 | away >> 8, away & 255])
            at += length
        else:
            plain.append(data[at])
            at += 1
    return bytes(out)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("packed", ["F", "U"])
def test_pcd(tmp_path, kind, packed):
    names = ["x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "_"]
    rows = np.zeros(COUNT, [(name, "<f8" if k < 3 else "<f4", (1 + (k == 7),)) for k, name in enumerate(names)])
    for k, column in enumerate(np.hstack((P, N)).T):
        rows[names[k]] = column[:, None]
    whole = (C[:, 0] << 16 | C[:, 1] << 8 | C[:, 2]).astype("<u4")
    rows["rgb"] = whole.view("<f4")[:, None]
    head = f"# .PCD v.7\nVERSION .7\nFIELDS {' '.join(names)}\nSIZE 8 8 8 4 4 4 4 4\nTYPE F F F F F F {packed} F\n"
    head += f"COUNT 1 1 1 1 1 1 1 2\nWIDTH {COUNT}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA {kind}\n"
    body = rows.tobytes()
    if kind == "ascii":
        shades = [f"{x:d}" if packed == "U" else f"{x.view(np.float32):.9g}" for x in whole]
        lines = zip(table(P, N).splitlines(), shades, strict=True)
        body = "".join(f"{line} {shade} 0 0\n" for line, shade in lines).encode()
    elif kind == "binary_compressed":
        fields = b"".join(rows[name].tobytes() for name in names)
        small = lzf(fields)
        body = np.array([len(small), len(fields)], "<u4").tobytes() + small
    path = tmp_path / "a.pcd"
    path.write_bytes(head.encode() + body)
    check(path, "nc")
    path.write_bytes(head.encode() + body[:-9])
    with refused(path, r"\.pcd: "):
        read_cloud(path)


@pytest.mark.parametrize(("size", "decimal"), [(4, True), (8, False), (8, True)])
def test_pcd_colors_as_decimal_numbers_or_doubles(tmp_path, size, decimal):
    whole = (C[:, 0] << 16 | C[:, 1] << 8 | C[:, 2]).astype("<u4")
    shades = [f"{x:d}" if decimal else f"{x.view(np.float32):.9g}" for x in whole]
    lines = "".join(f"{line} {shade}\n" for line, shade in zip(table(P).splitlines(), shades, strict=True))
    head = f"VERSION .7\nFIELDS x y z rgb\nSIZE 8 8 8 {size}\nTYPE F F F F\nWIDTH {COUNT}\nHEIGHT 1\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(head + lines)
    check(tmp_path / "a.pcd", "c")


def test_npy(tmp_path):
    for columns, expected in (((P,), ""), ((P, N), "n"), ((P, N, C), "nc"), ((P, C, N), "nc"), ((P, RGB16), "c")):
        np.save(tmp_path / "a.npy", np.concatenate(columns, axis=1))
        read = check(tmp_path / "a.npy", expected)
        assert open_stream(tmp_path / "a.npy").reading == read.reading
    np.save(tmp_path / "a.npy", np.rec.fromarrays(np.hstack((P, N)).T, names="X,Y,Z,Nx,Ny,Nz").view(np.ndarray))
    check(tmp_path / "a.npy", "n")


def test_npz(tmp_path):
    path = tmp_path / "a.npz"
    small = (N * 32767).round().astype(np.int16)
    for arrays, expected in (
        ({"points": P, "normals": N, "colors": C.astype(np.uint8), "scan": np.zeros(3)}, "nc"),
        ({"points": P, "normals": small}, "n"),
        ({"xyz": P, "rgb": np.hstack((C, ONE)).astype(np.uint16)}, "c"),
        ({"Points": P, "Colors": C / 255}, "c"),
        ({"points": np.hstack((P, N))}, "n"),
        ({"arr_0": np.hstack((P, N))}, "n"),
    ):
        np.savez(path, **arrays)
        read = check(path, expected)
        assert ("scan" in read.reading) == ("scan" in arrays)  # an array that is ignored is named


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_single_colors_above_the_range_change_no_others(kind):
    strays = [(255, 300), *((1, stray) for stray in (np.nextafter(kind(1), kind(2)), 1.02, 200))]
    for largest, stray in strays:
        values = (C / 255 * largest).astype(kind)
        values[3, 1] = stray
        assert np.allclose(colors_from(values), values.clip(0, largest) / largest)


@given(
    names=st.sampled_from(
        [("x", "nx", "r"), ("X", "Nx", "R"), ("Px", "NormalX", "Red"), ("x", "Normal X", "Diffuse Red")]
    ),
    separator=st.sampled_from([",", ";", "\t", ", "]),
    mark=st.sampled_from(["", "#", "# ", "//", "; ", "%"]),
    quote=st.sampled_from(["", '"', "'"]),
    unit=st.sampled_from(["", " [m]", "(m)", " {8 bit}"]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    order=st.permutations(range(10)),
)
def test_every_dialect_of_a_header_reads_the_same(tmp_path_factory, names, separator, mark, quote, unit, end, order):
    """Names decide, whatever the order of the columns, their separator, quotes, units and the mark of a comment."""
    points, normals, reds = names
    axes = dict(zip("xyz", "XYZ", strict=True))
    listed = [points.replace("x", a).replace("X", A) for a, A in axes.items()]
    listed += [normals[:-1] + (a if normals[-1] == "x" else A) for a, A in axes.items()]
    listed += [reds.replace("Red", A) if "Red" in reds else (a if reds == "r" else a.upper())
               for a, A in zip("rgb", ("Red", "Green", "Blue"), strict=True)]  # fmt: skip
    listed.append("cloud distance")
    values = np.hstack((P, N, C, I))[:, order]
    head = mark + separator.join(f"{quote}{listed[k]}{unit}{quote}" for k in order)
    path = tmp_path_factory.mktemp("dialect") / "a.txt"
    path.write_text((head + "\n" + table(values, sep=separator)).replace("\n", end), newline="")
    check(path, "nc")


def test_a_sample_touches_few_pages_of_a_mapped_file():
    rows = np.arange(1_000_000)
    found = sampled(rows, 10_000, run=500)
    assert (len(found), found[0], found[-1]) == (10_000, 0, 999_999)
    assert np.count_nonzero(np.diff(found) != 1) == 10_000 // 500 - 1
    assert sampled(rows[:10_000], 10_000).base is rows  # all of them, without a copy
