"""``triline keys``: certificates and access lists for encrypted platforms."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from ..formats.json_text import json_text
from .common_options import add_common

EXAMPLE = """triline keys new survey                                   # an authority, in the folder survey
  triline keys aircraft aircraft1 --authority survey --host 10.77.0.1
  triline keys desk ann --authority survey --host 10.77.0.1
  triline keys router ground --authority survey --host 192.0.2.1    # of a fleet: docs/fleet.md
  triline keys aircraft aircraft2 --authority survey --router 192.0.2.1
  triline keys list --authority survey
  triline keys revoke ann --authority survey"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    new = actions.add_parser("new", help="a new authority")
    new.add_argument("name", metavar="AUTHORITY", help="folder of the authority, and its name")
    for kind, text, host in (
        ("aircraft", "certify an aircraft: it publishes on the platform of its name", "address at which it listens"),
        ("router", "certify a router on the ground: aircraft and desks call it", "address at which it listens"),
        ("desk", "certify a desk: it reads, and publishes verdicts", "address of an aircraft that it calls"),
    ):
        one = actions.add_parser(kind, help=text)
        one.add_argument("name", metavar="NAME")
        one.add_argument("--host", action="append", default=[], metavar="HOST", help=f"{host} (repeatable)")
        where = "where the router listens" if kind == "router" else "where the platform meets"
        one.add_argument("--port", type=int, default=7447, metavar="N", help=f"{where} (default 7447)")
        calls = "a router on the ground that it calls, port 7447 unless another is named (repeatable)"
        one.add_argument("--router", action="append", default=[], metavar="HOST[:PORT]", help=calls)
        one.add_argument("--days", type=int, default=730, metavar="N", help="for which it holds (default 730)")
    revoke = actions.add_parser("revoke", help="strike somebody off all access lists")
    revoke.add_argument("name", metavar="NAME")
    actions.add_parser("list", help="who is certified")
    for action, sub in actions.choices.items():
        add_common(sub, again=True)
        if action != "new":
            sub.add_argument("--authority", type=Path, default=Path(), metavar="DIR", help="its folder (default: here)")


def run(args: argparse.Namespace) -> int:
    from ..bus.authority import Authority

    if args.action == "new":
        authority = Authority.create(Path(args.name))
        result = {"authority": str(authority.folder), "name": authority.name}
        text = f"{authority.folder}: authority {authority.name}; its key.pem certifies anybody: keep it off line"
    else:
        authority = Authority(args.authority)
        if args.action == "list":
            result = {"authority": authority.name, "members": [asdict(member) for member in authority.members]}
            text = _table(authority.members)
        elif args.action == "revoke":
            others = authority.revoke(args.name)
            result = {"revoked": args.name, "copy": [str(authority.folder / member.name) for member in others]}
            text = f"{args.name} is revoked" + _copy(authority.folder, [member.name for member in others])
        else:
            bundle = authority.certify(args.name, args.action, args.host, args.port, args.days, routers=args.router)
            others = [member.name for member in authority.valid if member.name != args.name]
            result = {"bundle": str(bundle), "copy": [str(authority.folder / name) for name in others]}
            text = f"{bundle}: bundle of {args.action} {args.name}, for --secure" + _copy(authority.folder, others)
    print(json_text(result) if args.json else text)
    return 0


def _copy(folder: Path, names: list[str]) -> str:
    """What has to be done so that others know."""
    if not names:
        return ""
    return "\naccess lists are new: copy again " + ", ".join(str(folder / name) for name in names)


def _table(members) -> str:
    from ..bus.authority import ROUTER, SECURE_PORT

    lines = [f"{'name':<24} {'kind':<9} {'until':<11} {'state':<20} hosts, > calls"]
    for member in members:
        state = f"revoked {member.revoked}" if member.revoked else "valid"
        port = f":{member.port}" if member.hosts and member.kind == ROUTER and member.port != SECURE_PORT else ""
        where = ", ".join(host + port for host in member.hosts) + "".join(f" > {router}" for router in member.routers)
        lines.append(f"{member.name:<24} {member.kind:<9} {member.until:<11} {state:<20} {where}")
    return "\n".join(lines)
