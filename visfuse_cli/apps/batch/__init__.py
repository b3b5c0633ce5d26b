"""`visfuse batch`: many recordings, any mix of commands, on the processes of a Dask cluster.

manifest -> items -> workers (a run each, its log, its record) -> outcomes -> results.csv
"""
