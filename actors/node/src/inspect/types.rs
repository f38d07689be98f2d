//! The structures of payload types on all nodes, and the types that two nodes have in different versions.

use std::{collections::BTreeMap, sync::Arc};

use sinew_lncl::undelivered::kind_name;
use sinew_model::facts::DeclaredTypes;
use sinew_runtime::{
    lock,
    outcome::Rejection,
    tid::Tid,
    wire::{Kind, Message, SchemaHash},
};
use sinew_schema::Schema;
use sinew_sync::AppTypes;

use super::reports::{AskSchemas, MismatchReport, MismatchesReport, SchemaReport, SchemasReport, TypeUser};
use crate::{
    NodeState,
    types::{Disagreement, Report},
};

/// Returns the structures of a type that the directory names.
pub(super) fn schemas(state: &Arc<NodeState>, question: &Message) -> Result<SchemasReport, Rejection> {
    let AskSchemas { kind } = question.decode().map_err(|_| Rejection::Malformed)?;
    let (declared, directory) = {
        let core = lock(&state.sync.core);
        (core.declared_types(), core.directory())
    };
    let mut by_hash = BTreeMap::new();
    for AppTypes { tid, name, types } in &declared {
        let user = || TypeUser { tid: *tid, name: name.clone() };
        if let Some(hash) = hash_of(&types.handles, kind) {
            entry(&mut by_hash, hash).handled_by.push(user());
        }
        if let Some(hash) = hash_of(&types.sends, kind) {
            entry(&mut by_hash, hash).sent_by.push(user());
        }
    }
    for (hash, report) in &mut by_hash {
        report.schema = encoded(state, kind, *hash, report);
    }
    // An application in another process names the types that it sends and those that it handles in one list.
    let has = |types: &DeclaredTypes| {
        hash_of(&types.handles, kind).or_else(|| hash_of(&types.sends, kind)).is_some()
    };
    let is_known = |tid: Tid| declared.iter().any(|app| app.tid == tid && has(&app.types));
    let handlers = directory.into_iter().filter(|app| app.kinds.contains(&kind) && !is_known(app.tid));
    let report = SchemasReport {
        name: kind_name(&state.lncl, kind),
        schemas: by_hash.into_values().collect(),
        unknown: handlers.map(|app| TypeUser { tid: app.tid, name: app.name }).collect(),
        left_out: 0,
    };
    Ok(report.shortened())
}

fn hash_of(types: &[(Kind, SchemaHash)], kind: Kind) -> Option<SchemaHash> {
    types.iter().find(|(other, _)| *other == kind).map(|(_, hash)| *hash)
}

fn entry(by_hash: &mut BTreeMap<SchemaHash, SchemaReport>, hash: SchemaHash) -> &mut SchemaReport {
    let empty = || SchemaReport { hash, schema: None, handled_by: Vec::new(), sent_by: Vec::new() };
    by_hash.entry(hash).or_insert_with(empty)
}

/// Returns the bytes of a structure that an application of this node has, or that the node of one of its users has
/// sent.
fn encoded(state: &NodeState, kind: Kind, hash: SchemaHash, users: &SchemaReport) -> Option<Vec<u8>> {
    if let Some(own) = state.types.schema_of_hash(kind, hash) {
        return Some(own);
    }
    let verdicts = lock(&state.types.verdicts);
    users.sent_by.iter().find_map(|user| verdicts.fetched(user.tid.node, (kind, hash))).map(Schema::encode)
}

/// Returns the types that applications of this node and of others have in different versions.
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn mismatches(state: &Arc<NodeState>) -> Result<MismatchesReport, Rejection> {
    let received = lock(&state.types.verdicts).disagreements();
    let sent = lock(&state.types.reported).reports();
    let names: BTreeMap<Tid, String> = {
        let declared = lock(&state.sync.core).declared_types();
        declared.into_iter().map(|app| (app.tid, app.name)).collect()
    };
    let received = received.iter().map(|one| of_receiver(state, one));
    // A report on an application that is not there any more is over.
    let sent = sent.iter().filter_map(|one| of_sender(state, one, &names));
    let mismatches = received.chain(sent).collect();
    Ok(MismatchesReport { mismatches, left_out: 0 }.shortened())
}

fn of_receiver(state: &NodeState, one: &Disagreement) -> MismatchReport {
    let target = Tid::new(state.ctx.node, one.path.target);
    MismatchReport {
        source: TypeUser { tid: one.path.source, name: one.source.clone() },
        target: TypeUser { tid: target, name: one.target.clone() },
        kind: one.path.kind,
        name: kind_name(&state.lncl, one.path.kind),
        policy: one.judgement.policy.word().to_owned(),
        treatment: one.judgement.treatment.word().to_owned(),
        differences: one.judgement.differences.clone(),
        seen: one.seen,
    }
}

fn of_sender(state: &NodeState, one: &Report, names: &BTreeMap<Tid, String>) -> Option<MismatchReport> {
    let user = |tid: Tid| Some(TypeUser { tid, name: names.get(&tid)?.clone() });
    Some(MismatchReport {
        source: user(Tid::new(state.ctx.node, one.source))?,
        target: user(one.target)?,
        kind: one.kind,
        name: kind_name(&state.lncl, one.kind),
        policy: one.judgement.policy.word().to_owned(),
        treatment: one.judgement.treatment.word().to_owned(),
        differences: one.judgement.differences.clone(),
        seen: one.seen,
    })
}
