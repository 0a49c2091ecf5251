# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures and pages."""
