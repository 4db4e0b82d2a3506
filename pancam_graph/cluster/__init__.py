"""Work shared among the workers of a Dask cluster, or of this machine: connection, checks, tasks, faults.

The room knows nothing of pictures: it runs a function on items elsewhere. Dask is imported when a cluster is
asked for.
"""

from pancam_graph.cluster._connect import connected as connected
from pancam_graph.cluster._connect import dashboard as dashboard
from pancam_graph.cluster._connect import log_workers as log_workers
from pancam_graph.cluster._crew import Crew as Crew
from pancam_graph.cluster._crew import Job as Job
from pancam_graph.cluster._machine import machine as machine
