"""`congrasp view`: the constraint studio and the window on a training, in a browser.

`state` holds the constraints that the user sets, `history` what of that can be undone, `description` what a page shows
of it; `motions` the grasps, `lanes` how they met the constraints, `files` what they are saved as, `diagnosis` why none
held; `training` what is known of a run and `recordings` its episodes on disk. None of them knows a browser. `session`
joins them to a policy, `server` offers that over HTTP, and `static/` is the page.
"""
