"""Which table and which columns each record is made of."""

from __future__ import annotations

from sqlalchemy import Table, func, null

from abbe.service.domain import decisions, measured, people, results, service_records
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.domain.owner import Owner
from abbe.service.storage import tables as t
from abbe.service.storage.mapping import RecordMapping


def owner_of(table: Table) -> RecordMapping[Owner]:
    """The process that a row belongs to."""
    return RecordMapping(Owner, table, host=table.c.owner_host, pid=table.c.owner_pid, start=table.c.owner_start)


MACHINE = RecordMapping(measured.MachineRecord, t.machines)
CAMPAIGN = RecordMapping(measured.CampaignRecord, t.campaigns)
RUN = RecordMapping(
    measured.RunRecord,
    t.runs,
    t.runs.join(t.campaigns, t.campaigns.c.id == t.runs.c.campaign_id),
    campaign=t.campaigns.c.name,
    owner=owner_of(t.runs),
)
CHUNK = RecordMapping(measured.ChunkRecord, t.chunks)
CHECKPOINT = RecordMapping(measured.CheckpointRecord, t.checkpoints)

SOLUTION = RecordMapping(results.SolutionRecord, t.solutions)
TABLE = RecordMapping(results.TableRecord, t.comp_tables)
VERIFICATION = RecordMapping(results.VerificationRecord, t.verifications)
DISCOVERY = RecordMapping(results.DiscoveryRecord, t.discoveries)
STEP = RecordMapping(results.StepRecord, t.discovery_steps)
MODEL = RecordMapping(results.ModelRecord, t.machine_models)

PROPOSAL = RecordMapping(decisions.ProposalRecord, t.proposals)
APPROVAL = RecordMapping(decisions.ProposalApproval, t.approvals)
REJECTION = RecordMapping(decisions.ProposalRejection, t.rejections)
PUSH_ENTRY = RecordMapping(decisions.PushEntryRecord, t.push_entries)
PUSH_MARK = RecordMapping(decisions.PushEntryRecord, t.push_entries, doc=null())
"""Without the document, which holds the images of tables."""

ALARM_ENTRY = RecordMapping(service_records.AlarmEntryRecord, t.alarm_entries)
SLOT = RecordMapping(service_records.SlotRecord, t.slots, reason=func.coalesce(t.slots.c.reason, ""))
HEARTBEAT = RecordMapping(service_records.HeartbeatRecord, t.heartbeats, owner=owner_of(t.heartbeats))
OUTBOX = RecordMapping(service_records.OutboxRecord, t.outbox)
REPLY = RecordMapping(service_records.ReplyRecord, t.replies)

USER = RecordMapping(people.UserRecord, t.users)
SESSION = RecordMapping(people.SessionRecord, t.sessions)
TOKEN = RecordMapping(people.TokenRecord, t.api_tokens)
AUDIT = RecordMapping(AuditEvent, t.audit)
