"""ROS 1 without ROS: names, XMLRPC with the master and other nodes, and TCPROS."""
