"""L2D2-C: learners ask each other for masks of their task, and take over the best one.

Nath et al. 2023 (CoLLAs), repository DMIU-ShELL/L2D2-C. We chose to query first after the first batch.
"""

from __future__ import annotations

from collections.abc import Sequence

from typing_extensions import override

from baselines.exchanges.exchange import MaskExchange
from baselines.methods.mask_lc import MaskLC
from baselines.methods.parts.masks import Masks
from ctgraph_rl.learn.collective import Help
from ctgraph_rl.learn.messages import Message, to_all

SHARE = 0.9
"""A peer's mask is wanted if this share of its return exceeds one's return."""

DIGITS = 6


class L2D2C(MaskExchange):
    """Each member asks all others for masks of its present task, by id, and overwrites its scores with the best.

    A query holds the id and the member's last mean return r, or 0. A peer offers its mask if its last return r' in the
    task is positive and 0.9 r' > r. The member takes the mask with the highest r', of the first peer if equal. The
    optimiser keeps its state.
    """

    def takes(self, method: Masks) -> bool:
        """Return whether a task's mask uses only its scores."""
        return not isinstance(method, MaskLC)

    @override
    def send(self, kind: str, member: int, received: Sequence[Message]) -> Sequence[Message]:
        if kind == "query":
            task = self.task_of(member)
            return to_all(kind, member, self.num_members, self._about(member, task))
        if kind == "request":
            best = self._best(member, received)
            return [Message(kind, member, offer.sender, {"task": offer.content["task"]}) for offer in best]
        answers = []
        for asked in received:
            task = asked.content["task"]
            content = self._about(member, task)
            if kind == "mask" and task in self.returns[member]:
                scores = self.methods[member].scores_of(task)
                answers.append(Message(kind, member, asked.sender, {**content, "scores": scores}))
            own = self.return_of(member, task)
            if kind == "offer" and own > 0 and _is_wanted(own, asked.content["reward"]):
                answers.append(Message(kind, member, asked.sender, content))
        return answers

    @override
    def receive(self, member: int, received: Sequence[Message]) -> Sequence[Help]:
        helps = []
        for mask in self._best(member, received):
            task = mask.content["task"]
            reward = mask.content["reward"]
            self.methods[member].take_scores(mask.content["scores"])
            values = {"task_id": task, "return_of_sender": reward, "return_before": self.return_of(member, task)}
            helps.append(Help(mask.sender, member, values))
        return helps

    def _about(self, member: int, task: int) -> dict[str, object]:
        return {"task": task, "reward": self.return_of(member, task)}

    def _best(self, member: int, received: Sequence[Message]) -> list[Message]:
        task = self.task_of(member)
        own = self.return_of(member, task)
        wanted = []
        for each in received:
            if each.content["task"] == task and _is_wanted(each.content["reward"], own):
                wanted.append(each)
        return sorted(wanted, key=lambda each: (-each.content["reward"], each.sender))[:1]


def _is_wanted(reward: float, own: float) -> bool:
    return round(SHARE * reward, DIGITS) > round(own, DIGITS)
