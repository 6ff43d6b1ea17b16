"""README and the other pages: their code and links are what is there now, and they stay short."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
OTHERS = [ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "experiments" / "README.md"]
PAGES = [README, *DOCS, *OTHERS]
SMALL = "num_episodes=4, num_real_first=2, model_updates=2"


def name(page):
    return str(page.relative_to(ROOT))


def code(page):
    """The Python of a page, all of it together."""
    return "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))


def prose(page):
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page):
    """What a link to a heading of the page may end in."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(page):
    """Links of a page to files or headings that are not there."""
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        path, _, heading = link.partition("#")
        target = page.parent / path if path else page
        known = target.suffix != ".md" or not heading or heading in anchors(target)
        if "://" not in link and not (target.exists() and known):
            yield link


def columns(page):
    """Of the widest table."""
    rows = [row for row in prose(page).splitlines() if row.startswith("|")]
    return max((row.strip().strip("|").count("|") + 1 for row in rows), default=0)


def test_the_code_runs_and_hands_a_trained_model_to_gymnasium():
    small, changes = re.subn(r"num_episodes=\d+, num_real_first=\d+", SMALL, code(README))
    assert changes == 1
    names = {}
    exec(small, names)
    assert names["metrics"]["real_return"].shape == (2, 10, 4)
    dreamed = gymnasium.make("Dreamed-v0")
    obs, _ = dreamed.reset(seed=0)
    assert dreamed.observation_space.contains(obs)
    obs, reward, *_ = dreamed.step(1)
    assert np.isfinite(obs).all() and np.isfinite(reward)
    gymnasium.registry.pop("Dreamed-v0")


def test_the_code_of_the_other_pages_runs():
    for page in DOCS:
        if page.name.startswith("your-own-") or page.name == "running-experiments.md":
            # which run in `test_guide` and `test_loaded`
            continue
        exec(compile(code(page), name(page), "exec"), {})


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_and_modules_exist(page):
    assert not list(broken(page))
    for module in re.findall(r"python -m jaxdyna\.([\w.]*\w)", page.read_text()):
        path = ROOT / "jaxdyna" / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module


def test_broken_links_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Here: and `there`\n[1](page.md) [2](#here-and-there) ![3](page.md#here-and-there)\n"
        "[4](https://example.org/none)\n```python\nnot[0](a_link)\n```\n"
        "[5](none.md) [6](#nowhere) [7](page.md#nowhere)\n"
    )
    assert list(broken(page)) == ["none.md", "#nowhere", "page.md#nowhere"]


def test_the_readme_is_short_and_says_first_how_to_test():
    lines = README.read_text().splitlines()
    assert len(lines) <= 150
    test = next(line for line in lines if "pytest" in line)  # what .ci/run starts
    assert test.startswith("python3 -m venv .venv && ") and "-m pytest" in test


@pytest.mark.parametrize("page", [README, *DOCS], ids=name)
def test_tables_fit_a_page(page):
    assert columns(page) <= 6


def test_the_reference_has_every_room_of_the_library():
    pages = "".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    said = set(re.findall(r"automodule:: jaxdyna\.(\w+)", pages))
    rooms = {path.stem for path in (ROOT / "jaxdyna").glob("[!_]*") if path.suffix in ("", ".py")}
    assert said == rooms


@pytest.mark.parametrize("page", DOCS, ids=name)
def test_a_page_is_in_the_side_bar(page):
    listed = page.relative_to(ROOT / "docs").with_suffix("")
    assert f'"{listed}"' in (ROOT / "docs" / "conf.py").read_text(), "add it to CONTENTS there"
