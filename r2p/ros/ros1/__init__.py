"""ROS 1 without ROS: `ros1:[http://MASTER:11311]`.

In the order to read it:

    transport      the URL; the link, and beside it parameters, on the parameter server
    middleware     the link's nodes on a ROS 1 network; it joins the two halves below
    names, environment    full names, remappings, and where the master and this computer are
    xmlrpc         calls between nodes, with xmlrpc_codec for their bytes
    registration   keeps nodes registered with the master; master: its calls; slave: what each node answers
    tcpros         the bytes of topics and services
    connections    TCPROS on asyncio; publishers, subscribers and services are the four things a connection may be for
"""
