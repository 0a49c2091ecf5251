# This source code is licensed under the MIT license found in the LICENSE file.
"""All commands of ``koap``; importing them takes seconds."""

from __future__ import annotations

from typing import Annotated

import tyro

from torchrl_koap.commands.data_commands import Convert, Demos, Validate
from torchrl_koap.commands.doctor import Doctor
from torchrl_koap.commands.embed import Embed
from torchrl_koap.commands.export import Export
from torchrl_koap.commands.run_commands import Bench, Curve, Eval, Inspect, Latency, Suggest
from torchrl_koap.commands.train import Train

Subcommand = (
    Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Demos, tyro.conf.subcommand("demos")]
    | Annotated[Embed, tyro.conf.subcommand("embed")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Curve, tyro.conf.subcommand("curve")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Suggest, tyro.conf.subcommand("suggest")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Latency, tyro.conf.subcommand("latency")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Validate, tyro.conf.subcommand("validate")]
)
