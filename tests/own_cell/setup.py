"""The cell as its configuration file, which is all that the package is told of it."""

from . import camera, world

SPEED = 0.3


def configuration(target="box", arm="panda", obstacles=False):
    """Text of the configuration file: a green box, or a white cylinder, of which masks tell.

    With `obstacles` it names the camera's post and the stand on which the target is put down.
    """
    x, y, z = world.STAND
    high = camera.PLACE[2] - 0.0125
    named = f"""
[[obstacle]]
name = "post"
shape = "cylinder"
size = [0.03, 0.03, {high}]
position = [{camera.PLACE[0] - 0.02}, {camera.PLACE[1]}, {high / 2}]

[[obstacle]]
name = "stand"
size = [0.14, 0.14, {z}]
position = [{x}, {y}, {z / 2}]
"""
    rows = ", ".join(f"[{', '.join(f'{v:.9f}' for v in row)}]" for row in camera.rotation())
    sought = {
        "box": 'shape = "box"\nhalf_size = [0.0225, 0.0175, 0.055]\nyaws = 6\ncolour = [0.10, 0.62, 0.22]',
        "cylinder": 'shape = "cylinder"\nhalf_size = [0.02, 0.02, 0.055]',
    }[target]
    return f"""[camera]
width = {camera.WIDTH}
height = {camera.HEIGHT}
fx = {camera.FOCAL}
fy = {camera.FOCAL}
cx = {camera.WIDTH / 2}
cy = {camera.HEIGHT / 2}
rotation = [{rows}]
position = [{", ".join(str(v) for v in camera.PLACE)}]

[shelf]
front = {world.FRONT}
back = {world.BACK}
right = {world.RIGHT}
left = {world.LEFT}
board = {world.BOARD}
ceiling = {world.CEILING}
thickness = {world.THICK}

[target]
{sought}

[arm]
model = "{arm}"
speed = {SPEED}
place = [{", ".join(str(v) for v in world.STAND)}]
{named if obstacles else ""}"""
