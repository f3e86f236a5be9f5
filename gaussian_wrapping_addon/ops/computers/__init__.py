# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs on several computers from the panel: test, submit, watch the parts, cancel, try again.

In: ``Scene.gwrap.computers``, job folders. Out: requests to a Manager in a thread; states of parts,
read by the add-on's timer.
"""
