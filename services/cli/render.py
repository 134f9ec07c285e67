"""Pictures of a hand or of a recorded episode, without OpenGL."""

import pathlib
from typing import Annotated

import tyro

from congrasp.common.hands import get_hand
from congrasp.services.cli.console import in_range

_FRAMING_STEP = 10  # the camera of a robot must contain every tenth frame


def hand(hand: str = "human", out: pathlib.Path = pathlib.Path("hand.png")) -> int:
    """Draw a hand open, half closed and closed, from three sides.

    Args:
      hand: Name of the hand.
      out: The PNG file to write.

    Examples:
      congrasp render hand --hand allegro
      congrasp render hand --hand my_hand --out my-hand.png
    """
    from congrasp.services.viz.hand_sheets import hand_sheet
    from congrasp.services.viz.sheets import save_png

    save_png(out, hand_sheet(get_hand(hand)))
    print(out)
    return 0


def episode(
    path: Annotated[pathlib.Path, tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("episode.png"),
    index: int = -1,
    success: bool = False,
    frames: Annotated[int, tyro.conf.arg(aliases=["--moments"])] = 8,
    video: pathlib.Path | None = None,
) -> int:
    """Draw frames of a recorded episode with its constraints: heading arrow, avoid region in red,
    waypoints, reference pose.

    Args:
      path: The folder of a run, or an MCAP file.
      out: The PNG file to write.
      index: Index of the recorded episode, from 0; -1 is the last episode.
      success: Apply --index to successful episodes only.
      frames: Number of frames in the picture.
      video: MP4 file to which the whole episode is also written.

    Examples:
      congrasp render episode runs/mine --success
      congrasp render episode runs/mine --index 0 --video grasp.mp4
    """
    from congrasp.services.grasp.arm_files import save_robot_video
    from congrasp.services.record.reader import pick_episode
    from congrasp.services.viz.film import Film, save_episode_video
    from congrasp.services.viz.render import episode_sheet
    from congrasp.services.viz.sheets import save_png

    in_range(1, frames=frames)
    chosen = pick_episode(path, index, success=success)
    save_png(out, episode_sheet(chosen, frames=frames))
    print(out)
    if video is not None:
        film = Film(overlays=True)
        if chosen.arm:
            framed = range(0, chosen.steps, _FRAMING_STEP)
            save_robot_video(video, chosen.arm, chosen, film, framed)
        else:
            save_episode_video(video, chosen, film)
        print(video)
    return 0


COMMANDS = {"hand": hand, "episode": episode}
