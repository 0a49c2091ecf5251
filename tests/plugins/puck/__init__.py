# This source code is licensed under the MIT license found in the LICENSE file.
"""A task of one's own, outside the package: three files, ``task.py``, ``env.py`` and ``expert.py``."""
