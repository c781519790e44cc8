"""Stop the wheels when commands stop coming: `timeout` guards against silence, `max_age` against what is too old.

The joystick falls silent after two seconds; the wheels stop 300 ms later, without a command.
"""

import r2p
from r2p.msg import PWM2, Velocity3

DUTY = 1000  # counts of the motor timer for 1 m/s
STOP = PWM2()


async def joystick(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3)
    ticks = 0
    async for _ in node.every(0.1):
        ticks += 1
        if ticks <= 20:
            await commands.publish(Velocity3(x=0.5))


async def wheels(node: r2p.Node) -> None:
    duties = node.advertise("pwm2", PWM2)

    def stop() -> None:
        duties.publish_nowait(STOP)
        print("no command for 0.3 s: stopped")

    commands = node.subscribe("velocity_cmd", Velocity3, max_age=0.2, timeout=0.3, on_timeout=stop)
    try:
        async for command in commands:
            left, right = command.x - command.w, command.x + command.w
            await duties.publish(PWM2(pwm1=round(left * DUTY), pwm2=round(right * DUTY)))
    finally:
        duties.publish_nowait(STOP)  # cancelled, or crashed: whatever ends this node stops the motors


async def motors(node: r2p.Node) -> None:
    async for duty in node.subscribe("pwm2", PWM2):
        print(duty)


if __name__ == "__main__":
    r2p.run(joystick, wheels, motors)
