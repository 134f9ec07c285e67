"""Pictures and films of the pages: a table of their commands, and the files next to them.

`make pictures` draws all of them again. A picture `NAME.png` has a file `NAME.png.json` with the
command that draws it, the policies that it shows, and the version of the renderer.
"""
