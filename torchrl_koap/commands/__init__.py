# This source code is licensed under the MIT license found in the LICENSE file.
"""One file per sub-command of ``koap``: a dataclass of options and the function that carries them out."""
