"""Both ends of a service with rclpy, run by its Python: `serve`, or `call NUMBER`, which prints the calls a second."""

import sys
import time

import rclpy
from std_srvs.srv import SetBool


def serve() -> None:
    node = rclpy.create_node("server")

    def handle(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = request.data
        return response

    node.create_service(SetBool, "switch", handle)
    print("ready", flush=True)
    rclpy.spin(node)


def call(number: int) -> None:
    node = rclpy.create_node("client")
    client = node.create_client(SetBool, "switch")
    client.wait_for_service()
    request = SetBool.Request(data=True)
    began = time.perf_counter()
    for _ in range(number):
        rclpy.spin_until_future_complete(node, client.call_async(request))
    print(number / (time.perf_counter() - began), flush=True)


if __name__ == "__main__":
    rclpy.init()
    if sys.argv[1] == "serve":
        serve()
    else:
        call(int(sys.argv[2]))
