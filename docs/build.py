"""Hook of mkdocs: adds the reference pages, which are made from the code, and checks that the site needs no network.

`mkdocs.yml` names this file. `pages` gives the generated pages as Markdown and needs nothing of mkdocs.
"""

from __future__ import annotations

import ast
import html
import inspect
import io
import re
import sys
import textwrap
import tokenize
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from html.parser import HTMLParser
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

ROOT = Path(__file__).resolve().parents[1]
NOTE = "*Made from the code at build time.*"


def pages() -> dict[str, str]:
    """Path below docs/ → Markdown, of every generated page."""
    from docs import gallery

    made = {
        **gallery.pages(),
        "reference/machine_file.md": machine_file_page(),
        "reference/mechanisms.md": mechanisms_page(),
        "reference/selectors_families.md": selectors_and_families_page(),
        "reference/recordings_exports.md": checks_and_forms_page(),
        "reference/cli.md": cli_page(),
        "reference/api.md": api_page(),
        "reference/mlflow_yml.md": settings_page(),
        "reference/fleet.md": fleet_page(),
    }
    for name in ("CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"):
        made[f"project/{name.removesuffix('.md').lower()}.md"] = _of_root(name)
    return made


# Schemas of YAML files


def machine_file_page() -> str:
    from data.machine import Machine
    from twin.schema import MATERIALS, TwinPart

    lines = ["# Machine file", "", NOTE, ""]
    lines += ["How to write one: [Write a machine file](../how-to/machine_file.md).", ""]
    lines += schema(Machine, "The file")
    lines += schema(TwinPart, "The twin part")
    lines += ["## Built-in materials", "", "| material | J/(kg K) | W/(m K) | µm/(m K) |", "|---|---|---|---|"]
    for name, m in MATERIALS.items():
        lines.append(f"| `{name}` | {m['specific_heat']:g} | {m['conductivity']:g} | {m['expansion']:g} |")
    return _text(lines)


def settings_page() -> str:
    from pipelines import settings

    lines = ["# mlflow.yml", "", NOTE, ""]
    lines += [_doc(settings), ""]
    lines += schema(settings._File, "Keys")
    return _text([*lines, "## The file of the repository", "", "```yaml", *_lines("mlflow.yml"), "```"])


def fleet_page() -> str:
    from pipelines.fleet import fleet_file

    lines = ["# Fleet file", "", NOTE, "", _doc(fleet_file).split("\n\n")[0], ""]
    return _text([*lines, *schema(fleet_file._File, "Keys")])


def schema(root: type[BaseModel], title: str) -> list[str]:
    """A section for a model and one for each model that it contains: key, type, default, meaning."""
    lines: list[str] = []
    for model in _contained(root):
        lines += ["", f"## {title}" if model is root else f"### {_title(model)}", "", _doc(model), ""]
        lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
        remarks = _comments(model)
        for key, field in model.model_fields.items():
            kind = _kind(field.annotation) + _bounds(field)
            meaning = field.description or remarks.get(key, "")
            lines.append(f"| `{key}` | {_cell(kind)} | {_cell(_default(field))} | {_cell(meaning)} |")
    return [*lines, ""]


def _contained(root: type[BaseModel]) -> list[type[BaseModel]]:
    """The model and those in its fields, each once, in the order of the keys."""
    found = [root]
    for model in found:  # grows while it is read
        for field in model.model_fields.values():
            found += [m for m in dict.fromkeys(_models(field.annotation)) if m not in found]
    return found


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _kind(annotation: Any) -> str:
    """An annotation as a reader of YAML names it."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(inner[0])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_kind(a) for a in inner if a is not NoneType))
    if origin is Literal:
        return ", ".join(f"`{a}`" for a in inner)
    if origin in (tuple, list, Sequence) and not (origin is tuple and Ellipsis not in inner):
        return f"list of {_kind(inner[0])}"
    if origin is tuple:
        return f"[{', '.join(_kind(a) for a in inner)}]"
    if origin in (dict, Mapping):
        return f"mapping of {_kind(inner[0])} to {_kind(inner[1])}"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return f"[{_title(annotation)}](#{_title(annotation).lower().replace(' ', '-')})"
    names = {str: "text", float: "number", int: "whole number", bool: "true or false", Path: "path", Any: "mapping"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _title(model: type[BaseModel]) -> str:
    """`ChannelPart` → Channel part."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__.strip("_")).capitalize()


def _bounds(field: FieldInfo) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    metadata = [*field.metadata]
    for part in get_args(field.annotation):
        metadata += getattr(part, "__metadata__", ())
    parts = [f"{sign} {getattr(m, name):g}" for m in metadata for name, sign in signs.items() if hasattr(m, name)]
    return f", {' and '.join(parts)}" if parts else ""


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "its defaults"
    if value is None or value in ("", {}, [], ()):
        return "–"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _comments(model: type[BaseModel]) -> dict[str, str]:
    """Field → the comment behind it in the source."""
    source = textwrap.dedent(inspect.getsource(model))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {t.start[0]: t.string.removeprefix("#").strip() for t in tokens if t.type == tokenize.COMMENT}
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    fields = [n for n in body.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)]
    return {n.target.id: comments[n.lineno] for n in fields if n.lineno in comments}  # type: ignore[union-attr]


# Registries


def mechanisms_page() -> str:
    from twin.mechanisms import MECHANISMS

    groups: dict[str, list[Any]] = {}
    for key in MECHANISMS:
        groups.setdefault(MECHANISMS[key].__module__, []).append(MECHANISMS[key])
    lines = ["# Mechanism catalogue", "", NOTE, ""]
    lines += [f"{len(MECHANISMS)} laws, which a machine file uses by their key and a diagnosis proposes."]
    lines += [
        "*Prior* is the standard deviation in the coordinate of the fit: *log* of the logarithm (positive values),"
    ]
    lines += ["*linear* in the unit (signed values), *logit* of a share between 0 and 1.", ""]
    lines += ["| key | effect | acts at |", "|---|---|---|"]
    for members in groups.values():
        lines += [f"| [`{m.key}`](#{m.key}) | {_cell(m.summary)} | {', '.join(m.acts_at)} |" for m in members]
    for module, members in groups.items():
        lines += ["", f"## {_heading(module)}", "", _doc(sys.modules[module]), ""]
        for m in members:
            lines += _mechanism(m)
    return _text(lines)


def _mechanism(m: Any) -> list[str]:
    lines = [f"### {m.key}", "", f"**{m.summary}**", "", "```text", *_wrapped(m.equation), "```", "", _doc(m), ""]
    facts = {
        "acts at": ", ".join(m.acts_at),
        "drivers": ", ".join(
            f"`{n}` ({'any unit' if n in m.any_unit else unit}{', optional' if n in m.optional_drivers else ''})"
            for n, unit in m.drivers.items()
        ),
        "temperatures": ", ".join(
            f"`{p}` ({m.port_roles.get(p, 'body')}{', optional' if p in m.optional_ports else ''})" for p in m.ports
        ),
        "needs": m.needs,
        "in recordings": m.signature,
        "source": m.source,
    }
    lines += ["| | |", "|---|---|", *(f"| {k} | {_cell(v)} |" for k, v in facts.items() if v), ""]
    if m.parameters:
        lines += ["| parameter | unit | meaning | usual | prior | bounds |", "|---|---|---|---|---|---|"]
    for s in m.parameters:
        usual, prior = _number(s.value), "–" if s.spread is None else f"{_number(s.spread)} {s.scale}"
        bounds = f"{_number(s.low)} to {_number(s.high)}"
        lines.append(f"| `{s.name}` | {_cell(s.unit)} | {_cell(s.words)} | {usual} | {prior} | {bounds} |")
    return [*lines, ""]


def selectors_and_families_page() -> str:
    from features.selectors import SELECTORS
    from models.families import FAMILIES

    lines = ["# Selectors and model families", "", NOTE, ""]
    lines += ["All compete in every `thermodrift train --effort`, but for what is marked *on request*.", ""]
    lines += ["## Selectors of temperature-sensitive points", ""]
    lines += ["| key | method | source |", "|---|---|---|"]
    for key in SELECTORS:
        s = SELECTORS[key]
        lines.append(f"| `{key}` | {_cell(s.summary)} | {_cell(s.source)} |")
    lines += ["", "## Model families", ""]
    lines += ["*Export*: the family is a program that runs at the control. *SD*: it states a standard deviation.", ""]
    lines += ["| key | method | export | SD | needs | source |", "|---|---|---|---|---|---|"]
    for key in FAMILIES:
        f = FAMILIES[key]
        needs = ", ".join(w for w, on in (("twin part", f.needs_twin), ("position", f.needs_position)) if on)
        marks = ["yes" if on else "–" for on in (f.has_program(), f.has_sd)]
        cells = (
            f"`{key}`",
            _cell(f.summary) + (", on request" if f.on_request else ""),
            *marks,
            needs or "–",
            _cell(f.source),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return _text(lines)


def checks_and_forms_page() -> str:
    from compensation.connectors import SINKS, SOURCES
    from compensation.exports import EXPORTS
    from data.checks import CHECKS
    from data.readers import READERS

    lines = ["# Checks, readers, connectors, exports", "", NOTE, ""]
    lines += ["## Checks of recordings", "", "| key | finds |", "|---|---|"]
    lines += [f"| `{k}` | {_cell(CHECKS[k].summary)} |" for k in CHECKS]
    lines += ["", "What a finding masks: [How the numbers are made](../method.md).", ""]
    lines += ["## Readers of files", "", "| suffix | |", "|---|---|"]
    lines += [f"| `.{k}` | {_cell(_first(READERS[k]))} |" for k in READERS]
    for title, registry in (("Sources of samples", SOURCES), ("Sinks of corrections", SINKS)):
        lines += ["", f"## {title}", "", "| scheme | |", "|---|---|"]
        lines += [f"| `{k}` | {_cell(_first(registry[k]))} |" for k in registry]
    lines += ["", "## Exports", "", "| `--to` | files |", "|---|---|"]
    lines += [f"| `{k}` | {_cell(EXPORTS[k].summary)} |" for k in EXPORTS]
    return _text(lines)


# Command line and API


def cli_page() -> str:
    from pipelines.cli import program

    root = program()
    commands = list(_commands("thermodrift", root))
    lines = ["# Command line", "", NOTE, "", root.help, ""]
    lines += [
        "Exit codes: 0 done, 1 the work failed, 2 bad arguments or input, 3 an alert (`status --alert`), 130 and 143 "
        "stopped by a signal.", "",
    ]  # fmt: skip
    lines += ["| command | |", "|---|---|"]
    lines += [f"| [`{n}`](#{_anchor(n)}) | {_cell(_sentence(c.help))} |" for n, c in commands]
    for name, command in commands:
        lines += [
            "",
            f"## {name}",
            "",
            inspect.cleandoc(command.help or ""),
            "",
            "```text",
            _usage(name, command),
            "```",
        ]
        if command.params:
            lines += ["", "| argument | type | default | meaning |", "|---|---|---|---|"]
            lines += [_parameter(p) for p in command.params]
    return _text(lines)


def _commands(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    for name, command in sorted(group.commands.items()):
        full = f"{prefix} {name}"
        if getattr(command, "commands", None):
            if getattr(command, "invoke_without_command", False):
                yield full, command
            yield from _commands(full, command)
        else:
            yield full, command


def _usage(name: str, command: Any) -> str:
    shown = [name]
    for p in command.params:
        one = p.name.upper() if not _is_option(p) else f"{p.opts[0]} {p.name.upper()}"
        if p.required:
            shown.append(one + (" …" if p.nargs == -1 else ""))
    return " ".join([*shown, "[options]"] if any(not p.required for p in command.params) else shown)


def _is_option(p: Any) -> bool:
    return bool(p.opts[0].startswith("-"))


def _parameter(p: Any) -> str:
    names = ", ".join(f"`{o}`" for o in [*p.opts, *p.secondary_opts]) if _is_option(p) else f"`{p.name.upper()}`"
    annotation = p.type_descriptor.annotation
    default = p.default() if callable(p.default) else p.default
    stated = "required" if p.required else "–" if default in (None, (), [], "", False) else f"`{_plain(default)}`"
    return f"| {names} | {_cell(_cli_kind(annotation))} | {_cell(stated)} | {_cell(p.help or '')} |"


def _cli_kind(annotation: Any) -> str:
    if annotation is bool:
        return "switch"
    if inspect.isclass(annotation) and issubclass(annotation, Enum):
        return ", ".join(f"`{e.value}`" for e in annotation)
    kind = _kind(annotation)
    return f"{kind.removeprefix('list of ')}, several" if kind.startswith("list of ") else kind


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return "on"
    return str(value.value if isinstance(value, Enum) else value)


def api_page() -> str:
    import thermodrift as td

    lines = ["# Python API", "", NOTE, "", "```python", "import thermodrift as td", "```", ""]
    lines += ["The commands as functions; progress is logged to the logger `thermodrift`. The registries are"]
    lines += ["`td.SELECTORS`, `td.FAMILIES` ([tables](selectors_families.md)) and `td.MECHANISMS`"]
    lines += ["([catalogue](mechanisms.md)): mappings of keys to classes.", ""]
    for name in sorted(td.__all__, key=str.lower):
        member = getattr(td, name)
        if inspect.isclass(member) or inspect.isfunction(member):
            where = f"{member.__module__}.{member.__qualname__}"
            lines += [f"::: {where}", "    options:", f"      heading: td.{name}", f"      toc_label: td.{name}", ""]
    return _text(lines)


# Text


def _of_root(name: str) -> str:
    """A Markdown file of the repository's root with its links into docs/ as seen from project/."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return re.sub(r"\]\(docs/", "](../", text)


def _lines(name: str) -> list[str]:
    return (ROOT / name).read_text(encoding="utf-8").splitlines()


def _heading(module: str) -> str:
    return module.rsplit(".", 1)[1].replace("_", " ").capitalize()


def _anchor(title: str) -> str:
    return title.lower().replace(" ", "-")


def _doc(item: Any) -> str:
    """Its own docstring as Markdown; an indented line that goes on with a paragraph is no code."""
    text = inspect.cleandoc(vars(item).get("__doc__") or "").replace("``", "`")
    paragraphs = text.split("\n\n")
    return "\n\n".join(p if p.startswith(" ") else "\n".join(map(str.strip, p.split("\n"))) for p in paragraphs)


def _first(item: Any) -> str:
    return _doc(item).split("\n\n")[0]


def _sentence(text: str | None) -> str:
    return re.split(r"(?<=\.)\s", inspect.cleandoc(text or ""))[0]


def _cell(text: str) -> str:
    """Text for a cell of a table: one line, no bar; quotation of < and > outside code."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    safe = [p if p.startswith("`") else html.escape(p, quote=False) for p in parts]
    return "".join(safe).replace("|", "\\|")


def _number(value: float | None) -> str:
    return "–" if value is None else {"inf": "∞", "-inf": "−∞"}.get(f"{value:g}", f"{value:g}".replace("-", "−"))


def _wrapped(equation: str) -> list[str]:
    return [line for part in equation.split("; ") for line in textwrap.wrap(part, 96, subsequent_indent="    ")]


def _text(lines: Iterable[str]) -> str:
    return "\n".join(lines).rstrip() + "\n"


# Events of mkdocs


def on_files(files: Any, config: Any) -> Any:
    """Adds the generated pages."""
    from mkdocs.structure.files import File

    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_post_build(config: Any) -> None:
    """Raises PluginError where a built page would load something from the network."""
    from mkdocs.exceptions import PluginError

    found = [line for path in sorted(Path(config.site_dir).rglob("*.html")) for line in loaded_from_network(path)]
    found += [
        f"{p.name}: {u}" for p in Path(config.site_dir).rglob("*.css") for u in _REMOTE_CSS.findall(p.read_text())
    ]
    if found:
        raise PluginError("the site must work without a network, but it loads " + "; ".join(found[:5]))


_REMOTE_CSS = re.compile(r"""(?:url\(|@import\s+)["']?((?:https?:)?//[^"')\s]+)""")
_LOADED_LINKS = {"stylesheet", "icon", "preload", "modulepreload", "preconnect", "dns-prefetch", "manifest"}


class _Loaded(HTMLParser):
    """Collects the remote addresses that a browser fetches when it shows the page."""

    def __init__(self) -> None:
        super().__init__()
        self.remote: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {k: v or "" for k, v in attrs}
        loads = tag != "link" or bool(_LOADED_LINKS & set(given.get("rel", "").split()))
        address = given.get("href", "") if tag == "link" else given.get("src", "")
        if loads and re.match(r"(https?:)?//", address):
            self.remote.append(address)
        self.remote += _REMOTE_CSS.findall(given.get("style", ""))


def loaded_from_network(page: Path) -> list[str]:
    """Each remote script, style, font or picture of an HTML page as ``PAGE: ADDRESS``."""
    text = page.read_text(encoding="utf-8")
    parser = _Loaded()
    parser.feed(text)
    styles = re.findall(r"<style[^>]*>(.*?)</style>", text, flags=re.DOTALL)
    return [f"{page.name}: {a}" for a in [*parser.remote, *(u for s in styles for u in _REMOTE_CSS.findall(s))]]
