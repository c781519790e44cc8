"""ROS 1 and ROS 2 without ROS: their types, and what travels between their nodes.

definitions   .msg, .srv and .action files; what ROS 1 computes from them
hashes        the hashes of types in ROS 2; type_names: how ROS writes the names of types
classes       message classes of ROS types, and definitions of r2p's classes
cdr           the serialisation of ROS 2; that of ROS 1 is r2p's own
conversions   which types of r2p are which of ROS; `standard` and `reports` have the functions
stamps        when what a message says was measured
clock         the time of a ROS network, /clock
tf            transforms, /tf
library       the definitions that come with ROS, and what the ends of a connection compare of a type
source        Python source of message classes
packages      packages for ROS with the types of r2p's classes
transport     makes a link to a ROS network, and its middleware, and runs both
link          a link to a ROS network; discovery, registrations: what is there, and what this side has there; gateways:
              how those on ROS find each other
topics        how topics travel; topic_classes, graph_names, qos, options: their types, names and quality of service;
              background: what is computed in a thread
middleware    the seam to ROS 1, rmw_zenoh or DDS
service_types   types of services in ROS; std_srvs: those that every ROS has
services        services between r2p and ROS nodes; service_calls: from a request to its answer
exposed_parameters   parameters of this module and of those behind a gateway; parameters: those of ROS 2's nodes
action_types    types of actions; action_server and action_client: the two ends
"""

from r2p.ros.action_client import ActionClient, ClientGoal
from r2p.ros.action_server import ActionServer, ServerGoal
from r2p.ros.action_types import Action, GoalAborted, GoalCanceled, GoalRejected, GoalState
from r2p.ros.options import QosChange, RosOptions

__all__ = [
    "Action",
    "ActionClient",
    "ActionServer",
    "ClientGoal",
    "GoalAborted",
    "GoalCanceled",
    "GoalRejected",
    "GoalState",
    "QosChange",
    "RosOptions",
    "ServerGoal",
]
