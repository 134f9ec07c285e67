"""`congrasp view`: the constraint studio and the window on a training, in a browser.

`state` holds the constraints that the user sets, `history` undoes and redoes changes, `description` describes them to
the page. `motions` keeps the grasps, `lanes` rates them by the constraints, `files` saves them, and `diagnosis`
explains failures. `training` holds the state of a run and `recordings` its episodes on disk. None of them depends on a
browser. `session` connects them to a policy, `sessions` keeps one per browser, `server` serves them over HTTP, and
`static/` is the page.
"""
