# This source code is licensed under the MIT license found in the LICENSE file.
"""The sub-commands of ``koap``: each is a dataclass of options that does its work when called."""
