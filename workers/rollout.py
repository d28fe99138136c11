"""The rollout worker: unit in, result out. It keeps nothing, so it can be killed and replaced at any moment."""

import itertools
import logging
import time
import traceback

from pipeline.rollout import collect
from workers.channels import Dealer
from workers.messages import (
    Header,
    MessageError,
    Ready,
    ResultMessage,
    UnitFailure,
    UnitMessage,
    decode,
    encode,
    shortened,
)
from workers.supervisor import Link

READY_INTERVAL_S = 1.0
_POLL_S = 0.1


def main(link: Link, endpoint: str, run_id: str) -> str:
    """Collect units for whichever learner is behind the endpoint, until asked to stop."""
    channel = Dealer(endpoint, link.identity)
    try:
        _serve(channel, link, run_id)
    finally:
        channel.close()
    return "stopped"


def _serve(channel: Dealer, link: Link, run_id: str) -> None:
    sequence = itertools.count()
    next_ready = time.monotonic()
    while not link.should_stop():
        if time.monotonic() >= next_ready:
            channel.send(encode(Ready(Header(run_id, "", link.identity, next(sequence)))))
            next_ready = time.monotonic() + READY_INTERVAL_S
        frames = channel.receive(_POLL_S)
        if frames is None:
            continue
        try:
            message = decode(frames)
        except MessageError as error:
            logging.warning("message dropped: %s", error)
            continue
        if not isinstance(message, UnitMessage) or message.header.run_id != run_id:
            logging.warning("message dropped: no unit of run %s", run_id)
            continue
        channel.send(_answer(message, Header(run_id, message.header.incarnation, link.identity, next(sequence))))
        next_ready = time.monotonic() + READY_INTERVAL_S


def _answer(message: UnitMessage, header: Header) -> list[bytes]:
    try:
        return encode(ResultMessage(header, collect(message.unit)))
    except Exception:
        text = traceback.format_exc()
        logging.error("unit %d/%d failed\n%s", message.unit.iteration, message.unit.group, text)
        return encode(UnitFailure(header, message.unit.iteration, message.unit.group, shortened(text)))
