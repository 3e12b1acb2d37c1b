"""From the sources in the folder ``page`` to what is written: a page with its field, or a module that fetches it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import struct
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from ...neural_fields.backend.files import write_whole
from .payload import deflated, text_of

SCRIPTS = (
    "decode.js",
    "network.js",
    "raster.js",
    "tracer.js",
    "camera.js",
    "kernels.js",
    "webgpu.js",
    "renderer.js",
    "paint.js",
    "section.js",
    "tools.js",
    "save.js",
    "interface.js",
    "controls.js",
    "page.js",
)
SHADERS = ("shaders.glsl", "shade.glsl", "march.wgsl")
MAGIC = b"mplicits-field\n"
MARK = "// mplicits-field: written by `mplicits web`"
# The whole page: nothing is fetched, nothing is sent, and only the scripts and styles with these digests run.
POLICY = (
    "default-src 'none'; script-src 'sha256-{boot}' 'sha256-{script}'; style-src 'sha256-{style}'; "
    "img-src blob: data:; base-uri 'none'; form-action 'none'"
)
# A page that is served fetches new fields from where it came from, and from nowhere else.
LIVE_POLICY = "; connect-src 'self'"


def fill_page(header: Mapping[str, Any], data: bytes, *, live: bool = False) -> str:
    """The page with a header and its bytes, and a policy that lets only its own script and styles run.

    Data stands in blocks without "<", which browsers do not run. A ``live`` page also fetches new fields from its
    server.
    """
    scripts = (*SCRIPTS, "main.js", *(("file.js", "live.js") if live else ()))
    script = "\n" + "\n".join(_bare(_source(name)) for name in scripts)
    style = "\n" + _source("style.css")
    boot = "\n" + _bare(_source("boot.js"))
    policy = POLICY.format(boot=_digest(boot), script=_digest(script), style=_digest(style)) + LIVE_POLICY * live
    parts = {
        "POLICY": policy,
        "STYLE": style,
        "BOOT": boot,
        "CODE": text_of(deflated(f"{_shaders()}\0{script}".encode())),
        "HEADER": _header(header).replace("<", "\\u003c"),
        "DATA": text_of(data),
    }
    return re.sub("@([A-Z]+)@", lambda found: parts[found[1]], _source("index.html"))


def write_folder(out: Path, header: Mapping[str, Any], data: bytes) -> None:
    """Write what another page needs to show a field, into a folder that is made if needed; raises InputError.

    ``field.bin`` is a `field_file`; ``mplicits-field.js`` is an ES module that defines the element
    ``<mplicits-field>``. Its types, a README and a page of its own come with it.
    """
    out.mkdir(parents=True, exist_ok=True)
    title = " ".join(str(header["title"]).split())
    write_whole(out / "field.bin", field_file(header, data))
    write_whole(out / "mplicits-field.js", _module())
    write_whole(out / "mplicits-field.d.ts", _source("mplicits-field.d.ts"))
    write_whole(out / "README.md", _source("embed.md").replace("@TITLE@", title))
    write_whole(out / "index.html", fill_page(header, data))


def field_file(header: Mapping[str, Any], data: bytes) -> bytes:
    """`MAGIC`, the length of the header as four bytes, little-endian, the header in JSON, and the deflated bytes."""
    text = _header(header).encode()
    return MAGIC + struct.pack("<I", len(text)) + text + data


def _module() -> str:
    texts = {"STYLE": _source("style.css"), "SHADERS": _shaders()}
    known = "\n".join(f"const {name} = {json.dumps(text)};" for name, text in texts.items())
    return "\n".join((MARK, known, *(_bare(_source(name)) for name in (*SCRIPTS, "file.js", "element.js")))) + "\n"


def _header(header: Mapping[str, Any]) -> str:
    return json.dumps(header, ensure_ascii=True, separators=(",", ":"))


def _shaders() -> str:
    return "\n".join(_bare(_source(name)) for name in SHADERS)


def _source(name: str) -> str:
    return (files("mplicits.pipelines.web") / "page" / name).read_text(encoding="utf-8")


def _bare(text: str) -> str:
    """A source without its indentation and the lines that are comments: the page has to be small."""
    lines = (line.strip() for line in text.splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
