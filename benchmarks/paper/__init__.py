# SPDX-License-Identifier: GPL-3.0-or-later
"""What the paper shows, shown on scenes whose surface is known.

``plug_in``: a plain 3DGS training against the same with Gaussian Wrapping; ``attenuation``: the
field under an earlier definition of the transmittance against the vacancy; ``meshers``: primal
adaptive meshing against two and nine pivots, and its steps. Each is a command and writes a record;
``document`` writes the page from the records.
"""
