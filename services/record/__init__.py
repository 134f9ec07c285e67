"""Logs of a run, published under `congrasp/<run>/log/<kind>/<role>/<name>`: recording to MCAP,
reading and drawing.

Kinds of messages (`common.wire.codec.Message`):

* metrics: meta `time` (s since 1970), `update` and/or `version`, `values` {name: number}; `a/b`
  names b in the group a.
* event: meta `time`, `level` (debug, info, warning, error, fatal), `text`.
* version: meta with the description of a policy version.
* rollout: a rollout as sent to the learner.
* episode: T control steps of one world. Arrays: `link_position` (T, L, 3), `link_quaternion` (T, L,
  4), `object_position` (T, 3), `object_quaternion` (T, 4), `contact_force` (T, L, 3) in the world
  frame, m and N; `q`, `q_target` (T, F), `u`, `u_target` (T, 6), `action` (T, M + 6), `table` (T,)
  bool, `reward/<term>` (T,); `goal/<field>` of `common.task.types.Goal` for this world, in the
  object frame; `surface_points` (N, 3), `surface_avoid` (N,) bool, `visual_vertices` (V, 3),
  `visual_faces` (F, 3), `piece_*` in the object frame, and for an object with colours
  `colour_values` (P, 3) uint8 at `colour_points` (P, 3). Meta: `hand`, `object`, `control_dt` (s),
  `version`, `actor`, `success`, `metrics` {name: number}. Quaternions are (w, x, y, z).

Topics of a recording: `/metrics/<role>/<name>`, `/version/<role>/<name>`, `/events/<role>/<name>`,
`/rollout/<actor>`, and for each actor `/episode/<actor>/` with `tf` (frames of all links and the
object), `scene` (hand, object, constraints; once an episode), `surface` (points of the graspable
and the avoid region), `hand/<link>` (points of each link in its frame, for viewers that draw no
scenes), `contacts` (table and forces), `signals` (rewards, forces, joints) and `raw` (the message).
"""
