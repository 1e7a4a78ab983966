"""What do a year's recordings say, asked in SQL?

The lake is plain Parquet, one file a run: DuckDB reads all of it without thermodrift. One query gives the rise of the
spindle's front bearing and the error of z after five hours for every speed.
"""

import tempfile
from pathlib import Path

import duckdb

import thermodrift as td
from docs.gallery.drawing import COLD, GOLD, WARM, picture

QUERY = """
select batch, max(spindle_rpm) as rpm,
       arg_max(front, time_s) - arg_min(front, time_s) as rise_K,
       arg_max(z, time_s) - arg_min(z, time_s) as error_um
from '{lake}/*/*/*.parquet' where time_s <= 5 * 3600
group by batch order by batch
"""

with tempfile.TemporaryDirectory() as folder:
    machine, files = td.sample_year(Path(folder) / "year", seed=0)
    lake = td.Lake(Path(folder) / "lake")
    report = td.ingest(files, machine, lake)
    table = duckdb.sql(QUERY.format(lake=Path(folder) / "lake")).df()

assert len(table) == 30 == sum(row.status == "new" for row in report.rows)
mean = table[table["rpm"].isin([2000, 4000, 6000])].groupby("rpm").mean(numeric_only=True)
print(f"error of z after 5 h, µm, by speed: {mean['error_um'].round(1).to_dict()}")
assert mean["error_um"].is_monotonic_increasing and mean["rise_K"].is_monotonic_increasing
assert abs(mean.loc[6000, "error_um"] - 90) < 10 and abs(mean.loc[6000, "rise_K"] - 20) < 2

labels = {"xlabel": "rise of the front bearing after 5 h, K", "ylabel": "error of z after 5 h, µm"}
with picture(__file__, "Thirty runs of a year, one query", **labels) as ax:
    for rpm, color in ((2000, COLD), (4000, GOLD), (6000, WARM)):
        of = table[table["rpm"] == rpm]
        label = f"{rpm}/min" if rpm < 6000 else "6000/min, alone or at times"
        ax.plot(of["rise_K"], of["error_um"], "o", color=color, label=label)
