"""Many axes: the study of each, on the processors of a machine or a cluster, and what the fleet shows."""

from servolens.fleet.axes import Axis, find_axes
from servolens.fleet.drift import Drift, Trend, trend
from servolens.fleet.executors import dask_executor, local_executor
from servolens.fleet.outliers import Outlier
from servolens.fleet.request import Request
from servolens.fleet.result import Fleet
from servolens.fleet.rows import columns_of, row_of
from servolens.fleet.run import InterruptedRunError, run_fleet
from servolens.fleet.tables import table_file, to_csv

__all__ = [
    "Axis",
    "Drift",
    "Fleet",
    "InterruptedRunError",
    "Outlier",
    "Request",
    "Trend",
    "columns_of",
    "dask_executor",
    "find_axes",
    "local_executor",
    "row_of",
    "run_fleet",
    "table_file",
    "to_csv",
    "trend",
]
