"""CAN controllers: ports to SocketCAN and to the interfaces of python-can."""
