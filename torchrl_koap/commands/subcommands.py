# This source code is licensed under the MIT license found in the LICENSE file.
"""All commands of ``koap``, called as their classes in lower case; importing them takes seconds."""

from torchrl_koap.commands.data_commands import Convert, Demos, Validate
from torchrl_koap.commands.doctor import Doctor
from torchrl_koap.commands.embed import Embed
from torchrl_koap.commands.run_commands import Bench, Curve, Eval, Export, Inspect, Latency, Suggest, Train

Subcommand = (
    Convert | Demos | Embed | Train | Eval | Curve | Bench | Inspect | Suggest | Export | Latency | Doctor | Validate
)
