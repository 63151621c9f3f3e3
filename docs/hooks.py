"""Pages that are generated when the site is built: command line, API, result schemas, notebooks."""

from __future__ import annotations

import argparse
import importlib
import json
import re
from pathlib import Path

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
API_ROOMS = (
    "torchcloth",
    "torchcloth.meshes",
    "torchcloth.materials",
    "torchcloth.effects",
    "torchcloth.boundaries",
    "torchcloth.dynamics",
    "torchcloth.losses",
    "torchcloth.recordings",
    "torchcloth.observe",
    "torchcloth.episodes",
    "torchcloth.identification",
    "torchcloth.pose",
    "torchcloth.diagnosis",
    "torchcloth.planning",
    "torchcloth.robots",
    "torchcloth.synthesis",
    "torchcloth.viewing",
    "torchcloth.testing",
    "torchcloth.errors",
)


def on_startup(command: str, dirty: bool) -> None:
    """Lay out the package as it is installed, for the reader of docstrings: robots/ is ``torchcloth.robots``."""
    package = ROOT / "out" / "api-source" / "torchcloth"
    package.mkdir(parents=True, exist_ok=True)
    for link in package.iterdir():
        link.unlink()
    for source in (*(ROOT / "torchcloth").iterdir(), *(ROOT / name for name in ("benchmarks", "robots", "training"))):
        if source.name != "__pycache__":
            (package / source.name).symlink_to(source)


def on_files(files: Files, config) -> Files:
    """Add the generated pages and the notebooks to the site."""
    pages = {"reference/command-line.md": command_line(), "reference/api.md": api_index()}
    pages |= {f"reference/api/{room}.md": api_page(room) for room in API_ROOMS}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        page = File(f"tutorials/{notebook.name}", str(ROOT), config["site_dir"], config["use_directory_urls"])
        page.abs_src_path = str(notebook)
        files.append(page)
    return files


def command_line() -> str:
    """Return the reference of all commands as Markdown, from their argument parsers."""
    from torchcloth.cli import build_parser

    parser = build_parser()
    (verbs,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    helps = {choice.dest: choice.help or "" for choice in verbs._choices_actions}
    text = ["# Command line", "", parser.description or "", "", "Exit codes: 0 done, 2 wrong input, 130 interrupted."]
    for name, verb in verbs.choices.items():
        usage = " ".join(verb.format_usage().removeprefix("usage: ").split())
        text += ["", f"## {name}", "", f"{helps.get(name, '')[:1].upper()}{helps.get(name, '')[1:]}.", ""]
        text += ["```text", usage, "```", "", "| argument | meaning |", "|---|---|"]
        for action in verb._actions:
            if action.dest == "help":
                continue
            names = ", ".join(action.option_strings) or str(action.metavar or action.dest)
            value = "" if not action.option_strings or action.nargs == 0 else f" {format_value(action)}"
            text.append(f"| `{names}{value}` | {format_help(verb, action)} |")
        if verb.epilog:
            text += ["", verb.epilog]
    return "\n".join(text) + "\n"


def format_value(action: argparse.Action) -> str:
    """Return what follows an option, e.g. ``NAME ...``."""
    word = action.metavar or ("{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper())
    word = " ".join(word) if isinstance(word, tuple) else word
    return f"{word} ..." if action.nargs in ("+", "*") else word


def format_help(verb: argparse.ArgumentParser, action: argparse.Action) -> str:
    """Return the help text of an option for a table cell."""
    text = verb._get_formatter()._expand_help(action) if action.help else ""
    return text.replace("|", "\\|").replace("<", "&lt;")


def api_index() -> str:
    """Return the list of public modules with their first sentences."""
    rows = ["# Python API", "", "Every public name, by module.", "", "| module | content |", "|---|---|"]
    for room in API_ROOMS:
        first = (importlib.import_module(room).__doc__ or "").strip().splitlines()[0]
        rows.append(f"| [`{room}`](api/{room}.md) | {first} |")
    return "\n".join(rows) + "\n"


def api_page(room: str) -> str:
    """Return the page of one module: its docstring, then each public object."""
    module = importlib.import_module(room)
    text = [f"# {room}", "", (module.__doc__ or "").strip(), ""]
    for name in getattr(module, "__all__", ()):
        value = getattr(module, name)
        if hasattr(value, "__path__") or type(value).__name__ == "module":
            continue
        if callable(value) and getattr(value, "__module__", None):
            text += [f"::: {value.__module__}.{name}", ""]
        else:
            text += [f"## {name}", "", f"`{value!r}`", ""]
    return "\n".join(text) + "\n"


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Fill placeholders ``<!-- table: NAME -->`` with generated tables."""
    return re.sub(r"<!-- table: ([\w.#/-]+) -->", lambda match: make_table(match[1]), markdown)


def make_table(name: str) -> str:
    """Return a generated table as Markdown.

    Args:
        name: "causes", or a file with a JSON Schema, "plan.json"; "diagnosis.json#cause" is one of its definitions.
    """
    from torchcloth.diagnosis.causes.glossary import format_catalogue
    from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
    from torchcloth.schemas import load_schema

    if name == "causes":
        return format_catalogue(list_known_hypotheses())
    file, _, definition = name.partition("#")
    schema = load_schema(file.removesuffix(".json"))
    node = schema["$defs"][definition] if definition else schema
    stars = file == "episode.json"  # elsewhere the writer writes all keys
    return "\n".join(["| key | meaning | unit, shape |", "|---|---|---|", *schema_rows(node, "", stars)])


def schema_rows(node: dict, prefix: str, stars: bool) -> list[str]:
    """Return a table row for each property of an object in a JSON Schema, and for those of objects in it.

    Args:
        node: the object.
        prefix: of the keys.
        stars: mark the required keys.
    """
    rows = []
    for key, child in node["properties"].items():
        star = " *" if stars and key in node.get("required", ()) else ""
        values = [f"`{json.dumps(v)}`" for v in child.get("enum", [child["const"]] if "const" in child else [])]
        meaning = "; ".join(filter(None, [child.get("description", ""), ", ".join(values)]))
        unit = "; ".join(u for u in (child.get("unit", ""), child.get("shape", "")) if u and u != "-")
        rows.append(f"| `{prefix}{key}`{star} | {meaning} | {unit} |".replace("|  |", "| |"))
        inner = {"": child, ".NAME": child.get("additionalProperties"), "[]": child.get("items")}
        for suffix, target in inner.items():
            if isinstance(target, dict) and "properties" in target:
                rows += schema_rows(target, f"{prefix}{key}{suffix}.", stars)
    return rows
