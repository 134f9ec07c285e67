"""Recording of the logs of a run, published under `congrasp/<run>/log/<kind>/<role>/<name>`.

Kinds of messages (`common.wire.codec.Message`):

* metrics: meta `time` (s since 1970), `update` and/or `version`, `values` {name: number}; `a/b`
  names b in the group a.
* event: meta `time`, `level` (debug, info, warning, error, fatal), `text`.
* version: meta with the description of a policy version.
* rollout: a rollout in the form that the learner gets, of all environments or of the first
  `RunConfig.log_rollout_worlds`.
* episode: the message of an `Episode` (`common.episode.episode`): T control steps of one world.

`recorder` receives them, `converter` makes entries of them within the `budget` of each publisher,
and `writer` writes these to MCAP files; `live` serves them to viewers, `metric_writers` passes
metrics on. `reader` reads the files.

Topics of a recording: `/metrics/<role>/<name>`, `/version/<role>/<name>`, `/events/<role>/<name>`,
`/rollout/<actor>`, and for each actor `/episode/<actor>/` with `tf` (frames of all links and the
object), `scene` (hand, object, constraints; once an episode), `surface` (points of the graspable
and the avoid region), `hand/<link>` (points of each link in its frame, for viewers that draw no
scenes), `contacts` (table and forces), `signals` (rewards, forces, joints) and `raw` (the message).
"""
