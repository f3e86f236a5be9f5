# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes and removes the private environment that workers run in, with venv and pip.

``pythons`` finds interpreters to make it from, ``commands`` has what is run, ``install`` runs it.
Standard library only.
"""
