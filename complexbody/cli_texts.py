# SPDX-License-Identifier: LGPL-3.0-or-later
"""Texts of the command line: examples, scene files, exit codes."""

EPILOG = """\
examples:
  complexbody check demos/impact.py               what would it do, and how long would it take?
  complexbody plan demos/impact.py                what does it need, and what not?
  complexbody run demos/impact.py                 as the file says
  complexbody run demos/impact.py --set cells=80 --until 2e-5 --out results/fine
  mpirun -n 4 complexbody run demos/impact.py     the same on four processes
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
  2  wrong input: what and where   130  stopped by Ctrl-C
  3  something is not installed    143  stopped by SIGTERM
"""
RUN_EPILOG = """\
Options that are not given are taken from DEFAULTS of the scene file, then as shown here. Results go
to DIR: run.json (what was run, and how it ended), ledger.csv, FIELD.xdmf with FIELD.h5 (open the
.xdmf in ParaView), probe-NAME.csv and picture.png.

examples:
  complexbody run demos/impact.py --set refine=1.5 --every 1e-7 --out results/fine
  complexbody run demos/impact.py --dissipation forward --start one-sided
  complexbody run demos/impact.py --accuracy 1e-2
  complexbody run demos/impact.py --integrator local-leapfrog --levels 3
  complexbody run demos/impact.py --fields u,stress --probe tip=1,0.5,0 --no-picture
  mpirun -n 4 complexbody run demos/impact.py
"""
