"""Every figure that README and docs quote, taken from stored results: `python -m docs.claims` writes them.

A page has `<!-- claim: KEY -->`, the sentence, `<!-- end of claim -->`. A sentence is a template around figures of a
stored result: a table below results/, whose JSON says how it was made, or the result of a published proof. A test fails
where a page has another sentence, and where a result is older than the version that a sentence is read for and does
not say so. A new claim is a function and a line in `CLAIMS`.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from scipy.stats import binomtest, ttest_rel

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
PAGES = (ROOT / "README.md", ROOT / "docs" / "index.md", ROOT / "docs" / "results.md")
_CLAIM = re.compile(r"(<!-- claim: (?P<key>\w+) -->\n?).*?(\n?<!-- end of claim -->)", re.DOTALL)


@dataclass(frozen=True)
class Share:
    """A number of cases out of several, with its 95 % interval (Wilson, 1927)."""

    hits: int
    of: int

    @property
    def range(self) -> str:
        """The interval in per cent."""
        found = binomtest(self.hits, self.of).proportion_ci(method="wilson")
        return f"{100 * found.low:.0f} to {100 * found.high:.0f}"

    @property
    def interval(self) -> str:
        return f"95 % interval {self.range} %"

    def __str__(self) -> str:
        return f"{self.hits} of {self.of}"


def table(name: str) -> tuple[pd.DataFrame, dict[str, str]]:
    """A stored table and how it was made: command, version, code, date."""
    made: dict[str, str] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return pd.read_csv(RESULTS / f"{name}.csv", keep_default_na=False), made


def made(name: str) -> str:
    """How a stored table was made, as a sentence."""
    about = table(name)[1]
    return f"`{about['command']}`, version {about['version']}, {about['date']}, rows in `results/{name}.csv`"


def proof(page: str) -> tuple[dict[str, tuple[str, str, int]], str]:
    """The first result of a published proof: share, 90 % interval and n by measure; and the version that answered."""
    text = (ROOT / "exam" / "results" / f"{page}.md").read_text(encoding="utf-8")
    rows = re.search(r"^\| measure \| goal \| all plants.*?\n\n", text, re.DOTALL | re.MULTILINE)
    version = re.search(r"opened [^,]*, thermodrift (\S+)", text)
    assert rows and version
    found = {}
    for line in rows[0].strip().splitlines()[2:]:
        cells = [c.strip().strip("*") for c in line.strip("|").split("|")]
        if cells[4].isdigit():
            found[cells[0]] = cells[2], cells[3], int(cells[4])
    return found, version[1]


def decision(machine: str) -> str:
    """What the default decision reaches on later runs of a machine."""
    rows, about = table("decision")
    rows = rows[rows["machine"] == machine]
    n, lacking = rows["run"].nunique(), rows.loc[rows["not_recorded"] != ""]
    shown = []
    for channel, own in rows.groupby("channel", sort=False):
        mean, spread = own["S_um"].mean(), own["S_um"].std(ddof=1)
        gap = ttest_rel(own["ridge_S_um"], own["S_um"])
        low, high = gap.confidence_interval(0.95)
        less = (own["ridge_S_um"] - own["S_um"]).mean()
        paired = f"ridge {own['ridge_S_um'].mean():.1f}, difference {less:.1f}, {low:.1f} to {high:.1f}"
        others = f"{paired}; no model {own['no_model_S_um'].mean():.1f}"
        shown.append(f"{channel} {mean:.1f} ± {spread:.1f} µm ({others})")
    below = Share(int((rows["S_um"] <= rows["bound90_S_um"]).sum()), len(rows))
    effort = about["command"].rpartition(" ")[2]
    return (
        f"mean S ± std over the last {n} runs, with all that `train --effort {effort}` does repeated before every "
        f"fourth of them on the runs so far: {'; '.join(shown)}. The differences are paired by run, with 95 % "
        f"intervals (Student's t). {below} runs stay below the 90 % bound that was "
        f"stated for them ({below.interval}).{_without(lacking)}"
    )


def _without(rows: pd.DataFrame) -> str:
    """Runs in which a sensor of their model never arrived, and what was left in them."""
    if rows.empty:
        return ""
    sensors = sorted({name for names in rows["not_recorded"] for name in names.split()})
    return (
        f" In {rows['run'].nunique()} of the runs {', '.join(sensors)} never arrived and was replaced: S "
        f"{rows['S_um'].mean():.1f} µm over {count(len(rows))}, no model {rows['no_model_S_um'].mean():.1f}."
    )


def count(n: int) -> str:
    return f"{n} run{'s' * (n > 1)} of a channel"


def kinds() -> str:
    """The diagnosis in the sealed proof on eight kinds of machine."""
    rows, about = table("proof_kinds")
    n, shares = rows["machine"].nunique(), {what: measure(rows) for what, measure in KIND_MEASURES.items()}
    said = ", ".join(f"{what} in {share} ({share.interval})" for what, share in shares.items())
    return f"{len(rows)} sealed simulated cases, {n} kinds of machine, version {about['version']}: {said}."


def single_named(rows: pd.DataFrame) -> Share:
    """Cases of one effect of the library, which is visible, in which a claim has its mechanism and its place."""
    own = rows[rows["kind"].isin(("one", "invisible")) & (rows["visible"] == 1)]
    return Share(int((own["named"] == 1).sum()), len(own))


def claims_true(rows: pd.DataFrame) -> Share:
    """Claims of all cases that are true."""
    return Share(int((rows["claims"] - rows["false_claims"]).clip(lower=0).sum()), int(rows["claims"].sum()))


def false_alarms(rows: pd.DataFrame) -> Share:
    """Cases in which nothing is missing and the answer is that something is."""
    own = rows[rows["kind"].isin(("nothing", "decoy"))]
    return Share(int((own["false_claims"] > 0).sum()), len(own))


def two_named(rows: pd.DataFrame) -> Share:
    """Cases of two visible effects in which both are named."""
    own = rows[(rows["kind"] == "two") & (rows["visible"] == 2)]
    return Share(int((own["named"] == 2).sum()), len(own))


def unlisted_called(rows: pd.DataFrame) -> Share:
    """Cases of a visible effect that is not in the library in which the answer says so."""
    own = rows[(rows["kind"] == "unlisted") & (rows["visible"] > 0)]
    return Share(int(own["called_unlisted"].astype(bool).sum()), len(own))


KIND_MEASURES: dict[str, Callable[[pd.DataFrame], Share]] = {
    "visible single effects named": single_named,
    "claims true": claims_true,
    "false alarms where nothing was missing": false_alarms,
    "two visible effects both named": two_named,
    "visible effects of no list called so": unlisted_called,
}


def kinds_table() -> str:
    """The measures by kind of machine, with 95 % intervals, and the time of a case."""
    rows, _ = table("proof_kinds")
    lines = [["machine (SIMULATED)", "cases", *KIND_MEASURES, "CPU time, median (s)"]]
    for name, own in [*rows.groupby("machine"), ("all", rows)]:
        shares = [f"{s} ({s.range})" if s.of else "" for s in (measure(own) for measure in KIND_MEASURES.values())]
        lines.append([str(name), str(len(own)), *shares, f"{pd.to_numeric(own['cpu_s']).median():.0f}"])
    return f"By kind of machine, with 95 % intervals in per cent:\n\n{_markdown(lines)}"


def kinds_compared() -> str:
    """The diagnosis next to its baselines on the same cases, with exact 90 % intervals."""
    rows, _ = table("proof_kinds_compared")
    lines = [["method (SIMULATED cases)", *(str(m) for m in rows["measure"].unique())]]
    for method, own in rows.groupby("method", sort=False):
        shares = [f"{100 * float(r['value']):.0f} % of {r['n']} ({_range(r)})" for _, r in own.iterrows()]
        lines.append([str(method), *shares])
    lead = rows[rows["measure"] == "right answers"].set_index("method")["lead"]
    best = rows.loc[rows["method"] == pd.to_numeric(lead).idxmin()].iloc[0]
    led = f"{100 * float(best['lead']):.0f} % of the answers ({_range(best, 'lead_')})"
    return (
        f"The standard methods on the same fits, with 90 % intervals in per cent. A right answer names every visible "
        f"effect and claims nothing else; the diagnosis leads the best of the others by {led}.\n\n{_markdown(lines)}"
    )


def _range(row: pd.Series, of: str = "") -> str:
    """A 90 % interval in per cent."""
    return f"{100 * float(row[of + 'low90']):.0f} to {100 * float(row[of + 'high90']):.0f}"


def _markdown(lines: list[list[str]]) -> str:
    """A Markdown table of a head and rows."""
    head, *rows = (f"| {' | '.join(cells)} |" for cells in lines)
    return "\n".join([head, "|" + "---|" * len(lines[0]), *rows])


def demonstrations() -> str:
    """What the demonstration says for each seed."""
    rows, about = table("demonstrations")
    lacking = rows[rows["concealed"] != "nothing"]
    found = Share(int((lacking["outcome"] == "found").sum()), len(lacking))
    wrong = int(rows["outcome"].isin(("wrong", "false_alarm", "found_and_more")).sum())
    nothing = rows[rows["concealed"] == "nothing"]
    silent = int((nothing["outcome"] == "nothing_right").sum())
    quiet = f", nothing is claimed in {silent} of {len(nothing)} that conceal nothing" if len(nothing) else ""
    lines = [["seed", "concealed (SIMULATED)", "outcome", "first claim", "probability", "left-out error", "limit"]]
    for r in rows.itertuples():
        p = f"{100 * float(str(r.probability)):.0f} %" if r.probability else ""
        lines.append(list(map(str, (r.seed, r.concealed, r.outcome, r.claimed, p, r.left_share, r.stated_limit))))
    return (
        f"{len(rows)} seeds, version {about['version']}: the effect is found in {found} that conceal one "
        f"({found.interval}){quiet}, and {wrong} answers have a false claim. "
        f"Left-out error: after by before, mean over the channels. Limit: what the "
        f"page says it would have claimed of an effect that it did not name.\n\n{_markdown(lines)}"
    )


def withheld() -> str:
    """The diagnosis on real recordings whose machine file lacks what it is known to need, or without an input."""
    rows, about = table("diagnosis_withheld")
    machines, without = ", ".join(sorted(set(rows["kind"]))), rows["concealed"].str.startswith("unlisted")
    known, hidden = rows[~without], rows[without]
    one, two = (all_named(by_effects(known, n), n) for n in (1, 2))
    right = Share(int((hidden["true"] > 0).sum()), len(hidden))
    inputs = ", ".join(text.removeprefix("unlisted_") for text in hidden["concealed"])
    r = [f"{float(v):.2f}" for v in hidden["r_hidden"] if v]
    course = f", and where its course is found, it correlates with the hidden input by {', '.join(r)}" if r else ""
    left = ", ".join(f"{float(v):.2f}" for v in hidden["left_share"] if v)
    return (
        f"{len(rows)} cases of real recordings ({machines}), used in the development, version {about['version']}. In "
        f"{len(known)} the machine file lacks what it is known to need: what is missing is named in {one} cases of one "
        f"effect, both in {two} cases of two; {true_claims(known)} claims true. In {len(hidden)} an input is hidden "
        f"({inputs}): heat of no list is claimed at its place in {right}{course}. Their left-out errors, after by "
        f"before: {left}."
    )


def by_effects(rows: pd.DataFrame, n: int) -> pd.DataFrame:
    """The cases in which so many effects were concealed."""
    effects = rows["concealed"].map(lambda text: 0 if text == "nothing" else text.count("+") + 1)
    return rows[effects == n].replace({"visible": {"": 0}, "named": {"": 0}})


def all_named(rows: pd.DataFrame, n: int) -> Share:
    """The cases in which all `n` effects are named."""
    return Share(int((rows["named"].astype(int) == n).sum()), len(rows))


def true_claims(rows: pd.DataFrame) -> Share:
    """The claims of all cases that are true."""
    made_of = rows["claimed"].map(lambda text: len([name for name in text.split("; ") if name]))
    return Share(int(rows["true"].sum()), int(made_of.sum()))


def proven(page: str, cases: str) -> str:
    """The main measures of a published proof."""
    found, version = proof(page)
    noticed, first = found["detection, visible"], found["mechanism first, one visible effect"]
    false = found["false alarms, nothing missing"]
    return (
        f"{cases}, version {version}: {noticed[0]} of {noticed[2]} visible effects noticed (90 % interval "
        f"{noticed[1]}), the mechanism first in {first[0]} of {first[2]} single ones ({first[1]}), false alarms in "
        f"{false[0]} of {false[2]} cases where nothing was missing ({false[1]})."
    )


def kills() -> str:
    """What random kills break."""
    rows, about = table("kills")
    broken = int(rows["kills_with_a_broken_invariant"].sum())
    each = ", ".join(f"{r.command} {r.kills}" for r in rows.itertuples())
    n = int(rows["kills"].sum())
    assert broken == 0, "state what was broken"
    return (
        f"After each of {n} kills at random moments ({each}; version {about['version']}) lake, tracking store and "
        f"registry were whole, and the repeated command gave the numbers of an undisturbed one (95 %: it fails after "
        f"at most {at_most(n)})."
    )


def control() -> str:
    """What hostile streams and ends of the command do at the receiver of a control."""
    rows, about = table("control")
    stream, ends = rows[rows["what"] == "stream"].iloc[0], rows[rows["what"] != "stream"]
    assert not {"step", "size"} & set("; ".join(rows["broken"]).split("; ")), "state what was broken"
    assert int(ends["with_a_broken_invariant"].sum()) == 0, "state what was broken"
    other = f" ({stream['broken'].replace('; ', ', ')})" if stream["broken"] else ""
    n, each = int(ends["n"].sum()), ", ".join(f"{r.what}: {r.n}" for r in ends.itertuples())
    moving = int(ends.loc[ends["what"] == "SIGKILL", "ended_while_moving"].sum())
    longest_s = ends["largest_active_after_s"].astype(float).max()
    return (
        f"In closed loop with the receiver of an export, version {about['version']}: in {stream['n']} hostile streams "
        f"({stream['samples']} samples, {stream['restarts']} restarts, simulated time) no step at the receiver was "
        f"above its limit and no correction beyond its size; {stream['with_a_broken_invariant']} of {stream['n']} "
        f"streams broke another condition{other}. In {n} ends of `compensate` "
        f"({each}; {moving} of the kills by SIGKILL alone while the correction moved) nothing was broken, and each of "
        f"the {n} starts, from the state that an earlier process left, was active at most {longest_s:.0f} s after its "
        f"first sample, of which warm-up takes 60 (95 %: something breaks in at most {at_most(n)} of ends)."
    )


def at_most(n: int) -> str:
    """The largest share that shows no case among n with a probability of 5 %."""
    return f"{100.0 * (1.0 - 0.05 ** (1.0 / n)):.1f} %"


CLAIMS: dict[str, Callable[[], str]] = {
    "decision_lathe": lambda: decision("lathe"),
    "decision_year": lambda: decision("year"),
    "decision_made": lambda: made("decision"),
    "kinds": kinds,
    "kinds_table": kinds_table,
    "kinds_compared": kinds_compared,
    "kinds_made": lambda: made("proof_kinds"),
    "demonstrations": demonstrations,
    "demonstrations_made": lambda: made("demonstrations"),
    "withheld": withheld,
    "withheld_made": lambda: made("diagnosis_withheld"),
    "proof": lambda: proven("proof", "300 sealed cases of simulated machining centres"),
    "proof_real": lambda: proven("proof_real", "36 sealed cases on real recordings that were used in the development"),
    "kills": kills,
    "kills_made": lambda: made("kills"),
    "control": control,
    "control_made": lambda: made("control"),
}


def rendered(text: str) -> str:
    """A page with every claim as the stored results have it.

    Raises:
        KeyError: an unknown claim.
    """
    return _CLAIM.sub(lambda m: f"{m[1]}{CLAIMS[m['key']]()}{m[3]}", text)


def claims_of(text: str) -> list[str]:
    """The keys of a page's claims."""
    return [m["key"] for m in _CLAIM.finditer(text)]


def main() -> None:
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = rendered(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            print(f"{page.relative_to(ROOT)}: written", file=sys.stderr)


if __name__ == "__main__":
    main()
