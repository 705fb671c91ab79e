#!/usr/bin/env python3
"""Lists what is too large or goes in circles: python3 scripts/size.py [--all]

Files of more than 500 lines, functions of more than 80 lines or with more than 7 parameters, cycles between the files of a crate (by the
paths that begin with `crate::`, `super::` or a child's name), and cycles between crates. Ends with 1 if there is any that the list `ALLOWED` does not
name with a reason, or if the list names one that is gone. `--all` prints the allowed ones, too. Only Python's standard library.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINES, FUNCTION, PARAMETERS = 500, 80, 7

# What stays as it is, and why. A key is what the script prints.
KERNEL = "a kernel: its arguments are strides and pointers, its body one loop nest"
ALLOWED = {
    "tce-nn: gemm.rs gemm/kernel.rs": "gemm.rs is the face of its kernel, and its types are the kernel's arguments",
    "crates/tce-nn/src/gemm/kernel.rs: fn drive": KERNEL,
    "crates/tce-nn/src/gemm/kernel.rs: fn tile()": KERNEL,
    "crates/tce-nn/src/gemm/kernel.rs: fn tiles()": KERNEL,
    "crates/tce-nn/src/kernels.rs: fn backward()": KERNEL,
    "crates/tce-nn/src/stack.rs: fn block()": KERNEL,
}


def main():
    findings = {}
    crates = sorted(p.parent for p in ROOT.glob("crates/*/Cargo.toml"))
    for crate in crates:
        files = {path: path.read_text() for path in sorted(crate.glob("src/**/*.rs"))}
        for path, text in files.items():
            name = path.relative_to(ROOT).as_posix()
            lines = text.count("\n")
            if lines > LINES:
                findings[name] = f"{lines} lines"
            for function, length, parameters in functions(code_only(text)):
                if length > FUNCTION:
                    findings[f"{name}: fn {function}"] = f"{length} lines"
                if parameters > PARAMETERS:
                    findings[f"{name}: fn {function}()"] = f"{parameters} parameters"
        for cycle in cycles(imports(crate / "src", files)):
            names = " ".join(sorted(p.relative_to(crate / "src").as_posix() for p in cycle))
            findings[f"{crate.name}: {names}"] = "files in a cycle"
    for cycle in cycles(dependencies(crates)):
        findings["crates: " + " ".join(sorted(cycle))] = "crates in a cycle"
    new = {key: what for key, what in findings.items() if key not in ALLOWED}
    gone = [key for key in ALLOWED if key not in findings]
    for key, what in new.items():
        print(f"{what}: {key}")
    for key in gone:
        print(f"allowed, but not found any more: {key}")
    if "--all" in sys.argv:
        for key, reason in ALLOWED.items():
            print(f"allowed ({findings.get(key, 'gone')}): {key}: {reason}")
    print(f"{len(new)} found, {len(findings) - len(new)} allowed", file=sys.stderr)
    sys.exit(1 if new or gone else 0)


def code_only(text):
    """The text with blanks in place of comments and the inside of strings, so that braces and commas in them do not count."""

    def blank(match):
        return re.sub(r"[^\n]", " ", match[0])

    pattern = r'//[^\n]*|/\*.*?\*/|b?r#*"(?:.*?)"#*|b?"(?:\\.|[^"\\])*"|b?\'(?:\\.|[^\'\\])\''
    return re.sub(pattern, blank, text, flags=re.DOTALL)


def functions(text):
    """(name, lines, parameters) of every function with a body."""
    for match in re.finditer(r"\bfn\s+(\w+)", text):
        i = match.end()
        if i < len(text) and text[i] == "<":
            i = closing(text, i, "<", ">") + 1
        start = text.find("(", i)
        if start < 0:
            continue
        end = closing(text, start, "(", ")")
        body = re.compile(r"[{;]").search(text, end)
        if not body or body[0] == ";":
            continue
        last = closing(text, body.start(), "{", "}")
        line = text.rfind("\n", 0, match.start())
        yield match[1], text.count("\n", line + 1, last) + 1, parameters(text[start + 1 : end])


def parameters(text):
    """Parameters between a function's brackets, without `self`."""
    depth, count, part = 0, 0, ""
    for character in text + ",":
        if character == "," and depth == 0:
            if part.strip() and not re.fullmatch(r"\s*(&\s*('\w+\s+)?)?(mut\s+)?self\s*", part):
                count += 1
            part = ""
            continue
        depth += (character in "([{<") - (character in ")]}>")
        part += character
    return count


def closing(text, start, opens, closes):
    """Where the bracket at `start` is closed; `->` closes nothing."""
    depth = 0
    for i in range(start, len(text)):
        if text[i] == opens:
            depth += 1
        elif text[i] == closes and text[i - 1] not in "-=":
            depth -= 1
            if depth == 0:
                return i
    return len(text) - 1


def imports(src, files):
    """For every file of a crate, the files whose items it names, through re-exports, too. What a parent only re-exports of its children it
    does not need."""
    modules = {module_of(src, path): path for path in files}
    texts = {}
    named = {}
    for path, text in files.items():
        here = module_of(src, path)
        text = code_only(re.sub(r"#\[cfg\(test\)\]\s*(?:pub(?:\(\w+\))? )?mod tests? \{.*", "", text, flags=re.DOTALL))
        text = re.sub(r"#\[cfg\(test\)\]\s*(?:pub(?:\(\w+\))? )?(?:mod|use) [^;{]+;", "", text)
        for match in re.finditer(r"^(?:pub(?:\(\w+\))? )?use ([^;]+);", text, re.MULTILINE):
            # A child names what its parent has imported as it names what the parent has.
            shared = match[0].startswith("pub") or path.name in ("mod.rs", "lib.rs", "main.rs")
            if shared:
                for target in expanded(re.sub(r"\s+", " ", match[1]), 0):
                    target, _, alias = target.partition(" as ")
                    parts = absolute(target.split("::"), here, modules)
                    if parts:
                        named[(*here, alias or parts[-1])] = parts
                if match[0].startswith("pub") or here == ():
                    text = text.replace(match[0], "", 1)
        texts[path] = text

    def file_of(parts):
        at, steps = (), 0
        parts = list(parts)
        while parts and steps < 20:
            steps += 1
            if (*at, parts[0]) in modules:
                at = (*at, parts.pop(0))
            elif (*at, parts[0]) in named:
                target = named[(*at, parts.pop(0))]
                at, parts = (), [*target, *parts]
            else:
                break
        return modules.get(at) if at else None

    graph = {path: set() for path in files}
    for path, text in texts.items():
        here = module_of(src, path)
        children = {m[-1] for m in modules if m[:-1] == here and m}
        relative = [c for c in children if re.search(rf"(?<![\w:]){c}::", text)]
        for target in [*paths(text), *relative]:
            found = file_of(absolute(target.split("::"), here, modules) or [])
            if found and found != path:
                graph[path].add(found)
    return graph


def absolute(parts, here, modules):
    """A path's parts from the crate's root; None for another crate's."""
    if parts[0] == "crate":
        return parts[1:]
    if parts[0] in ("super", "self"):
        base = list(here)
        while parts and parts[0] in ("super", "self"):
            base, parts = base[:-1] if parts[0] == "super" else base, parts[1:]
        return base + parts
    return [*here, *parts] if (*here, parts[0]) in modules else None


def module_of(src, path):
    """The module's path, as a tuple of names."""
    parts = path.relative_to(src).with_suffix("").parts
    return tuple(parts[:-1] if parts[-1] in ("mod", "lib", "main") else parts)


def paths(text):
    """All paths that begin with `crate::` or `super::`, with the lists in braces written out."""
    for match in re.finditer(r"\b(crate|super)::", text):
        yield from expanded(text, match.start())


def expanded(text, start):
    prefix = re.compile(r"(?:\w+::)*").match(text, start)[0]
    i = start + len(prefix)
    if i < len(text) and text[i] == "{":
        end = closing(text, i, "{", "}")
        depth, part = 0, ""
        for character in text[i + 1 : end] + ",":
            if character == "," and depth == 0:
                if part.strip():
                    yield from expanded(prefix + part.strip(), 0)
                part = ""
                continue
            depth += (character == "{") - (character == "}")
            part += character
    else:
        name = re.compile(r"\w*(?: as \w+)?").match(text, i)[0]
        yield (prefix + name).rstrip(":")


def dependencies(crates):
    names = {crate.name for crate in crates}
    return {c.name: set(tomllib.loads((c / "Cargo.toml").read_text()).get("dependencies", {})) & names for c in crates}


def cycles(graph):
    """Strongly connected parts of more than one node (Tarjan)."""
    index, low, stack, out = {}, {}, [], []

    def visit(node):
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph[node]):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            part = []
            while True:
                part.append(stack.pop())
                if part[-1] == node:
                    break
            if len(part) > 1:
                out.append(part)

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return out


if __name__ == "__main__":
    main()
