"""`congrasp view`: the constraint studio and the window on a training, in a browser.

`state` holds the constraints that the user sets with the arrow and the paint of `drawing`, and
undoes changes. `page` makes the page's content of them, of hands and of motions, which it also
keeps and saves. `grasping` grasps with a policy. `catalogue` holds the objects, `training` the
state of a run, and `recordings` its recorded episodes. None of them depends on a browser. `session`
connects them, runs the `jobs` and opens the page. `server` serves it over HTTP: the `application`
of Starlette answers requests that `access` admits by the `routes` of each browser's session
(`browser_sessions`), over limited connections (`services.ops.http_server`). `static/` is the page.
`static/vendor/` has three.js 0.185.1 (MIT licence): `build/three.{module,core}.min.js` of its npm
package.
"""
