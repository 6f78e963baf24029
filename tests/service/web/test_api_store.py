"""What the interface asks of the store is answered alike by both databases; of two processes one gets a key."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from abbe.service.domain.results import ProposalRejection
from abbe.service.storage.repositories.pages import LISTINGS
from abbe.service.storage.store import Store


def test_pages_of_everything(url: str) -> None:
    with Store.open(url) as store:
        machine = store.machines.add("m", {"name": "m"})
        for name in ("a", "b"):
            campaign = store.campaigns.add(machine, name, {"big": "x"})
            for k in range(5):
                store.runs.finish(store.runs.start(campaign, f"r{k}", "laser_linear", "identify", {}), "complete", "", None)
        assert [row.columns["run_id"] for row in store.pages.page("runs", {"campaign": "b", "machine": "m"}, None, 3)] == ["r4", "r3", "r2"]
        assert [row.number for row in store.pages.page("runs", {"role": "identify"}, 4, 100)] == [3, 2, 1]
        assert store.pages.page("runs", {"campaign": "' OR 1=1 --"}, None, 3) == []
        for kind in LISTINGS:
            assert isinstance(store.pages.page(kind, dict.fromkeys(LISTINGS[kind].filters, None), None, 10), list)
            assert store.pages.row(kind, 77) is None
        assert store.pages.row("campaigns", 1).doc == {"big": "x"}
        solution = store.solutions.add(1, "joint", [1], {})
        number = store.proposals.add("m", solution, {"n": 1}, "d")
        store.proposals.reject(ProposalRejection(proposal_id=number, name="somebody", login="user:somebody", reason="too warm"))
        assert [one.reason for one in store.proposals.rejections(number)] == ["too warm"]
        assert store.proposals.rejections(number + 1) == []


def test_of_two_services_one_gets_a_key(url: str) -> None:
    with Store.open(url) as one, Store.open(url) as two, ThreadPoolExecutor(2) as pool:
        for k in range(20):
            claims = [pool.submit(store.replies.claim, "user:x", f"k{k}", "d") for store in (one, two)]
            found = [claim.result() for claim in claims]
            assert sum(reply is None for reply in found) == 1
            assert {(reply.digest, reply.status) for reply in found if reply is not None} == {("d", None)}
        one.replies.drop("user:x", "k0")
        assert two.replies.claim("user:x", "k0", "other") is None
        two.replies.keep("user:x", "k0", 409, "{}")
        two.replies.drop("user:x", "k0")
        again = one.replies.claim("user:x", "k0", "other")
        assert (again.status, again.body) == (409, "{}")
