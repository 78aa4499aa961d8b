# SPDX-License-Identifier: LGPL-3.0-or-later
"""Texts of the command line: examples, scene files, exit codes."""

EPILOG = """\
examples:
  complexbody check demos/impact.py               what would it do, and how long would it take?
  complexbody plan demos/impact.py                what does it need, and what not?
  complexbody run demos/impact.py                 as the file says
  complexbody run demos/impact.py --set cells=80 --until 2e-5 --out results/fine
  mpirun -n 4 complexbody run demos/impact.py     the same on four processes
  complexbody resume results/fine                 go on with a run that was stopped
  complexbody chart demos/graded_crack.py         which method is the cheapest for which error?
  complexbody show results/impact                 pictures of its fields, energies and probes
  complexbody info                                versions, compiler, what is missing

a scene file is a Python file with
  import complexbody as cb
  def scene(comm, cells=40):                      parameters are set by --set cells=80
      return cb.Scene(mesh, body, supports=…, loads=…, initial=…)
and, if it likes,
  DEFAULTS = dict(until=1e-5, every=1e-7)         what the options of run override
  def check(result): ...                          raises AssertionError if the physics is wrong
  def picture(result, path): ...                  draws into the file path
  def exact(t, …): ...                            the exact solution, for chart

exit codes:
  0  done                          4    the run diverged
  1  a bug of complexbody          5    the scene file's check failed
  2  wrong input: what and where   6    no checkpoint to resume from
  3  something is not installed    130  stopped by Ctrl-C
                                   143  stopped by SIGTERM
"""
RUN_EPILOG = """\
Options that are not given are taken from DEFAULTS of the scene file, then as shown here. Results go
to DIR: run.json (what was run, and how it ended), ledger.csv, FIELD.xdmf with FIELD*.h5 (open
the .xdmf in ParaView), probe-NAME.csv, checkpoints and picture.png. Ctrl-C and SIGTERM make a
checkpoint and end the run, SIGUSR1 makes one and goes on; kill -9 leaves all readable.

examples:
  complexbody run demos/impact.py --set refine=1.5 --every 1e-7 --out results/fine
  complexbody run demos/impact.py --dissipation forward --start one-sided
  complexbody run demos/impact.py --accuracy 1e-2
  complexbody run demos/impact.py --integrator local-leapfrog --levels 3
  complexbody run demos/impact.py --fields u,stress --probe tip=1,0.5,0 --no-picture
  mpirun -n 4 complexbody run demos/impact.py
"""
RESUME_EPILOG = """\
The scene file and all options are those of the run (run.json); files go on where they were at the
checkpoint. On as many ranks the result is that of a run that was never stopped, to the bit; on
another number to round-off. A checkpoint that is damaged, or of another scene, is refused by name
and the one before it is taken. With a later end the step stays what it was.

examples:
  complexbody resume results/fine
  mpirun -n 4 complexbody resume results/fine --until 4e-5
"""
