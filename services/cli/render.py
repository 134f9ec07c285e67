"""`congrasp render`: pictures of a hand or of a recorded episode, without OpenGL."""

import pathlib
from typing import Annotated

import tyro


def hand(hand: str = "human", out: pathlib.Path = pathlib.Path("hand.png")) -> int:
    """Draw a hand open, half closed and closed, from three sides.

    Args:
      hand: Name of the hand.
      out: The PNG file to write.
    """
    from common.hands import get_hand
    from services.viz.render import hand_sheet
    from services.viz.sheets import save_png

    save_png(out, hand_sheet(get_hand(hand)))
    print(out)
    return 0


def episode(
    path: Annotated[pathlib.Path, tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("episode.png"),
    index: int = -1,
    success: bool = False,
    moments: int = 8,
    video: pathlib.Path | None = None,
) -> int:
    """Draw a recorded episode in a few moments, with its constraints: approach arrow, O- in red, waypoints, pose.

    Args:
      path: A run's folder, or one MCAP file.
      out: The PNG file to write.
      index: Which of the recorded episodes, from 0; -1 is the last.
      success: Count only episodes that succeeded.
      moments: Pictures on the sheet.
      video: Also write the whole episode as an MP4, at half its speed while the table stands.
    """
    from services.viz.render import episode_sheet, pick_episode, save_episode_video
    from services.viz.sheets import save_png

    chosen = pick_episode(path, index, success=success)
    save_png(out, episode_sheet(chosen, moments=moments))
    print(out)
    if video is not None:
        save_episode_video(video, chosen)
        print(video)
    return 0


COMMANDS = {"hand": hand, "episode": episode}
