"""`congrasp view`: the constraint studio and the window on a training, in a browser.

`state` holds the constraints that the user sets, `lanes` how a motion met them, `training` what is known of a run and
`recordings` its episodes on disk; none of them knows a browser. `studio` joins them to a policy, `server` offers that
over HTTP, and `static/` is the page.
"""
