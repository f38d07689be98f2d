//! What a node says of its access list, and has done with it.

use std::sync::Arc;

use sinew_runtime::{
    outcome::Rejection,
    tid::AppAddress,
    time::Time,
    wire::{Class, Message},
};

use super::reports::{AccessReport, AccessVerdict, AskAccess, ReloadReport};
use crate::{
    access::{Explanation, Question},
    lncl::Owner,
    node::NodeHandle,
    stores::{Stores, lock},
};

/// Longest account of what is wrong with a list, in characters.
const FAULTS_MAX: usize = 16 * 1024;

/// What the list says of messages between the two that the question names.
pub(super) fn explained(stores: &Arc<Stores>, question: &Message) -> Result<AccessReport, Rejection> {
    let AskAccess { source, target } = question.decode().map_err(|_| Rejection::Malformed)?;
    let Some(access) = stores.access.get() else {
        return Ok(AccessReport { is_given: false, verdicts: Vec::new() });
    };
    if target.node != stores.node || !target.is_single() || target.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let verdict = |class| {
        let Explanation { is_allowed, why } = access.explain(Question { source, target, group: None, class });
        AccessVerdict { class, is_allowed, why }
    };
    Ok(AccessReport { is_given: true, verdicts: Class::ALL.map(verdict).to_vec() })
}

/// Whether the application at `app` is one of this process, or of another one of the same user or of root.
fn is_of_the_nodes_user(stores: &Stores, app: AppAddress) -> bool {
    match lock(&stores.registry).owner_of(app) {
        Some(Owner::Node) => true,
        // Where there is no list there is nobody else here, and nothing to read.
        Some(Owner::Client { .. }) => {
            stores.access.get().is_none_or(|access| access.is_of(app, rustix::process::geteuid().as_raw()))
        }
        None => false,
    }
}

/// Has the list read again, if somebody of the node's own user on this host wants it. spec: INSPECT-7
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn reloaded(stores: &Arc<Stores>, question: &Message) -> Result<ReloadReport, Rejection> {
    let refused = |words: String| {
        let now = stores.access.get().map(|access| access.summary());
        ReloadReport {
            rules: now.map_or(0, |now| now.rules as u64),
            clients: now.map_or(0, |now| now.clients as u64),
            refused: Some(words.chars().take(FAULTS_MAX).collect()),
        }
    };
    if question.header.source.node != stores.node {
        let why = "an access list is read again for a program of its node's own host only: run `sinew reload` there";
        return Ok(refused(why.to_owned()));
    }
    if !is_of_the_nodes_user(stores, question.header.source.app) {
        let why = "an access list is read again for programs of its node's own user and of root only: run `sinew reload` as that user";
        return Ok(refused(why.to_owned()));
    }
    if stores.access.get().is_some_and(|access| !access.may_be_read(Time::now())) {
        return Ok(refused("the access list was read a moment ago: ask again in a second".to_owned()));
    }
    Ok(match NodeHandle::of(stores.clone()).reload_access() {
        Ok(now) => ReloadReport { rules: now.rules as u64, clients: now.clients as u64, refused: None },
        Err(why) => refused(why.to_string()),
    })
}
