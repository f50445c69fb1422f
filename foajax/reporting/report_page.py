"""Writes the report of a set of runs: one page that needs no other file, and its figures beside it."""

from __future__ import annotations

import base64
import html
import io
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from foajax.cli import make_directory
from foajax.config.parse import ConfigError, file_name
from foajax.reporting import cost, curves
from foajax.reporting.curves import RunData
from foajax.reporting.groups import Groups, all_games, differing_keys, experiments_of, final_scores, runs_of
from foajax.runs.agents import load_agent
from foajax.runs.status import newest_checkpoint
from foajax.viewing import heatmap
from foajax.viewing.heatmap import HeatMap
from foajax.viewing.recording import progress_bar, watch

PAGE = "index.html"


class Page:
    """Collects the page's body and writes the figures beside it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._parts: list[str] = []

    def add(self, text: str) -> None:
        self._parts.append(text)

    def figure(self, figure: Figure, name: str, alternative: str) -> None:
        """Appends a figure as SVG, and writes it as a PNG too."""
        figure.savefig(self._directory / f"{name}.png", dpi=160)
        content = io.BytesIO()
        with rc_context({"svg.hashsalt": "foajax"}):  # the same figure, the same file
            figure.savefig(content, format="svg", metadata={"Date": None})
        self.add(_image(content.getvalue(), "svg+xml", alternative))

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> None:
        """Appends a table of HTML cells; the columns `numbers` are aligned to the right."""

        def line(cells: Sequence[str], tag: str) -> str:
            kind = [' class="number"' if i in numbers else "" for i in range(len(cells))]
            inner = (f"<{tag}{k}>{cell}</{tag}>" for k, cell in zip(kind, cells, strict=True))
            return f"<tr>{''.join(inner)}</tr>"

        lines = [line(head, "th"), *(line(row, "td") for row in rows)]
        self.add(f'<div class="wide"><table>{"".join(lines)}</table></div>')

    def write(self) -> Path:
        """Writes the page; returns its path."""
        page = (Path(__file__).parent / "report.html").read_text(encoding="utf-8")
        file = self._directory / PAGE
        file.write_text(page.replace("{{body}}", "\n".join(self._parts)), encoding="utf-8")
        return file


def _image(content: bytes, kind: str, alternative: str) -> str:
    data = base64.b64encode(content).decode()
    return f'<img src="data:image/{kind};base64,{data}" alt="{html.escape(alternative)}">'


def build(
    games: Mapping[str, Groups], maps: Mapping[Path, HeatMap], *, out: str, preset: str | None, repeats: int
) -> Path:
    """Writes page and figures to `out`; returns the page's path. `repeats`: of each timing; 0 leaves out the costs."""
    directory = make_directory(out)
    page = Page(directory)
    runs = runs_of(games)
    page.add(f"<h1>foajax: {preset or 'report'}</h1>")
    page.add(f'<p class="note">{len(runs)} run{"s" if len(runs) > 1 else ""} on {html.escape(", ".join(games))}.</p>')
    _add_summary(page, games, repeats)
    _add_curves(page, games)
    _add_scores(page, games)
    _add_maps(page, runs, maps, directory)
    _add_differences(page, games)
    _add_runs(page, runs, directory)
    return page.write()


def _add_summary(page: Page, games: Mapping[str, Groups], repeats: int) -> None:
    page.add("<h2>At a glance</h2>")
    first = {(game, name): runs[0].config for game, groups in games.items() for name, runs in groups.items()}
    costs = cost.measure_decisions(list(first.values()), repeats=repeats) if repeats else [{}] * len(first)
    rows = []
    for (game, name), record in zip(first, costs, strict=True):
        seeds = games[game][name]
        cells = [html.escape(game), html.escape(name), str(len(seeds)), f"{min(s.env_steps[-1] for s in seeds):,.0f}"]
        cells += [
            f"{np.mean([s.time[-1] for s in seeds]) / 3600:.2f}",
            html.escape(str(final_scores({name: seeds})[name])),
        ]
        if record:
            cells += [f"{record['pixels_actual']:,}", f"{100 * record['pixels_ratio']:.0f} %"]
            cells += [f"{record['torso_flops'] / 1e6:.2f}", f"{record['decision_flops'] / 1e6:.2f}"]
            cells += [f"{record['decision_us_batch1'] / 1e3:.2f}"]
        rows.append(cells)
    head = ["game", "experiment", "runs", "env_steps", "hours", "score"]
    if repeats:
        head += ["values<br>shown", "of the<br>frame", "torso<br>MFLOP", "decision<br>MFLOP", "decision<br>ms"]
    page.table(head, rows, numbers=range(2, len(head)))
    page.add(
        '<p class="note">Score: interquartile mean over runs [95 % interval], of evaluated games where a run has a '
        "score.json, else of its last 100 games of training. Cost: one decision, batch 1, timed on this machine.</p>"
    )


def _add_curves(page: Page, games: Mapping[str, Groups]) -> None:
    page.add("<h2>Learning curves</h2>")
    colours = curves.colours_of(experiments_of(games))
    for game, groups in games.items():
        figure = curves.draw_curves(groups, game, colours)
        page.figure(figure, f"curves-{file_name(game)}", f"learning curves on {game}")
    note = "thin: single seeds; thick: their mean where all seeds have scores, with its 95 % bootstrap interval"
    page.add(f'<p class="note">Full games, unclipped ({note}).</p>')


def _add_scores(page: Page, games: Mapping[str, Groups]) -> None:
    page.add("<h2>Final scores</h2>")
    panels = {game: final_scores(groups) for game, groups in games.items()}
    if together := all_games(games):
        panels["all games, normalised"] = together
        page.add('<p class="note">Normalised: 0 is random play, 1 a human tester (in seek: who sees everything).</p>')
    figure = curves.draw_scores(panels, curves.colours_of(experiments_of(games)))
    page.figure(figure, "scores", "interquartile means of the final scores")


def _add_maps(page: Page, runs: Sequence[RunData], maps: Mapping[Path, HeatMap], directory: Path) -> None:
    if not maps:
        return
    page.add("<h2>Where they look</h2><div class='maps'>")
    for run in runs:
        if run.path in maps:
            title = f"{run.config.name} on {run.config.game}"
            figure = heatmap.draw(maps[run.path], title)
            name = file_name(f"{run.config.game}-{run.config.name}-s{run.config.seed}")
            file = directory / f"heatmap-{name}.png"
            figure.savefig(file, dpi=130)
            page.add(f"<div>{_image(file.read_bytes(), 'png', f'heat map of {title}')}</div>")
    page.add("</div>")


def _add_differences(page: Page, games: Mapping[str, Groups]) -> None:
    page.add("<h2>How they differ</h2>")
    for game, groups in games.items():
        rows = differing_keys([runs[0] for runs in groups.values()])
        if rows:
            cells = [[f"<code>{html.escape(k)}</code>", *(html.escape(str(v)) for v in row)] for k, row in rows.items()]
            page.table([html.escape(game), *map(html.escape, groups)], cells)
        else:
            page.add(f'<p class="note">{html.escape(game)}: in their seeds alone.</p>')


def _add_runs(page: Page, runs: Sequence[RunData], directory: Path) -> None:
    page.add("<h2>Runs</h2>")
    rows = []
    for run in runs:
        files = sorted([*run.path.glob("render/episode-*"), *run.path.glob("player/*.html"), *run.path.glob("*.html")])
        links = (f'<a href="{quote(os.path.relpath(f, directory))}">{html.escape(f.name)}</a>' for f in files)
        cells = [f"<code>{html.escape(str(run.path))}</code>", str(run.config.seed), f"{run.env_steps[-1]:,.0f}"]
        rows.append([*cells, f"{run.final_score:.4g}", _origin(run), " ".join(links)])
    page.table(["run", "seed", "env_steps", "score", "from", "to watch"], rows, numbers=(1, 2, 3))


def _origin(run: RunData) -> str:
    """Says where the score is from; an evaluation may be of an earlier checkpoint."""
    if run.evaluation is None:
        return "training"
    evaluated = run.evaluation.get("env_steps", run.env_steps[-1])
    where = "" if evaluated == run.env_steps[-1] else f" at {evaluated:,} env_steps"
    return f"evaluated{where}{', greedy' if run.evaluation.get('policy') == 'greedy' else ''}"


def find_maps(games: Mapping[str, Groups], episodes: int) -> dict[Path, HeatMap]:
    """Finds heat maps in the runs' directories. For a group without any, its first run plays `episodes` games."""
    maps: dict[Path, HeatMap] = {}
    for groups in games.values():
        for seeds in groups.values():
            first, found = seeds[0], {run.path: heat for run in seeds if (heat := _stored_map(run))}
            if not found and episodes and first.config.gaze.mode != "none" and (heat := _make_map(first, episodes)):
                found = {first.path: heat}
            maps |= found
    return maps


def _stored_map(run: RunData) -> HeatMap | None:
    """Reads a run's heat map, if the newest checkpoint made it in whole games with sampled actions."""
    newest = newest_checkpoint(run.path) or int(run.env_steps[-1])  # a run may be kept without its checkpoints
    heat, file = heatmap.of_run(run.path, newest), run.path / "render" / heatmap.FILE
    if heat is None and file.exists():
        note(f"{file}: left out, as it may not show whole games with sampled actions at {newest:,} env_steps")
    return heat


def _make_map(run: RunData, episodes: int) -> HeatMap | None:
    """Plays games and makes their heat map; None if the run has no agent that can play."""
    try:
        stored = load_agent(run.path, trust=True)  # as `read_run` was told
        with progress_bar() as bar:
            games = watch(stored, bar, episodes=episodes, seed=0, greedy=False, max_steps=None)
            heat = heatmap.heat_map([game._replace(images=()) for game in games])
    except ConfigError as error:
        note(f"no heat map: {error}")
        return None
    file = run.path / "render" / heatmap.FILE
    there = heatmap.read(file) if file.exists() else None
    if there is None or (there.policy != "greedy" and there.whole_games is not False):  # a user made others on purpose
        try:
            heatmap.save(heat, make_directory(file.parent), f"{run.config.name} on {run.config.game}")
        except (ConfigError, OSError) as error:
            note(f"{file}: cannot be written ({error}); the page shows the heat map")
    return heat


def note(text: str) -> None:
    """Prints a line on stderr, beside the results."""
    print(text, file=sys.stderr, flush=True)
