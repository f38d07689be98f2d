//! The reports of a node about itself: reads its state, and asks the root for the tree.

mod discovery;
mod peers;

use std::{
    borrow::Cow,
    sync::{Arc, Weak, atomic::Ordering},
    time::Duration,
};

use sinew_model::{
    barrier::{BarrierKind, BarrierStatus},
    directory::Absence,
    facts::Trouble,
};
use sinew_ndl::{IdleApp, TroubledApp};
use sinew_runtime::{
    lock,
    mailbox::MessageAges,
    outcome::Rejection,
    protection::{OutputState, State, outputs},
    router::tap::Way,
    supervision::Strategy,
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Flags, Kind},
};
use sinew_security::UnixTime;
use sinew_sync::OwnApp;

use self::discovery::Discovery;
use super::reports::{
    APPS_MAX, AgesReport, AppReport, AppsReport, AuditReport, BarrierReport, CertificateReport, GuardReport,
    IdleReport, KindReport, LISTED_MAX, MISSING_MAX, Missing, NodeReport, PEERS_MAX, SecurityReport,
    SeenMessage, TREE_MAX, TreeLine, TreeReport, TroubleReport, WaitReport, WatchReport,
};
use super::{
    reach, refused,
    watches::{Fetched, Observed},
};
use crate::{CommandError, NodeHandle, NodeState, Supervised, audit};

/// Time limit for the root's answer: a root that hangs must not delay the other questions for long.
const ROOT_WITHIN: Duration = Duration::from_secs(1);
/// Maximum characters of a text from an application: a panic message.
const TEXT_MAX: usize = 256;

/// The data from which the answers are made.
pub(super) struct Answers {
    /// Weak: the answering thread does not keep the state alive.
    state: Weak<NodeState>,
    began: Time,
}

impl Answers {
    pub(super) const fn new(state: Weak<NodeState>, began: Time) -> Self {
        Self { state, began }
    }

    /// Returns the state, or `None` when the node has ended.
    pub(super) fn state(&self) -> Option<Arc<NodeState>> {
        self.state.upgrade()
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn node(&self, state: &Arc<NodeState>) -> Result<NodeReport, Rejection> {
        let now = Time::now();
        let mut peers: Vec<_> = peers::peers(state, now).into_values().collect();
        let left_out = peers.len().saturating_sub(PEERS_MAX) as u64;
        peers.truncate(PEERS_MAX);
        let (mut room, mut idle_room) = (LISTED_MAX, LISTED_MAX);
        for peer in &mut peers {
            peer.troubles.truncate(room);
            room -= peer.troubles.len();
            peer.idle.truncate(idle_room);
            idle_room -= peer.idle.len();
        }
        let (ndl, groups) = (Discovery::of(state, now), state.ctx.config.ndl.asked_groups());
        let (refusals, refusals_left_out) = refused::refusals(state, now);
        let (guards, guards_left_out) = guards(state.ctx.node);
        Ok(NodeReport {
            node: state.ctx.node,
            name: state.ctx.config.name.clone(),
            incarnation: state.ctx.incarnation,
            up_us: micros(now.since(self.began)),
            pid: std::process::id(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            stopping: state.ctx.stopping.load(Ordering::Relaxed),
            refused: NodeHandle::of(state.clone()).refused(),
            project: state.ctx.config.project.clone(),
            security: Some(security(state, UnixTime::now())),
            interface: state.ctx.config.ndl.interface.to_string(),
            is_interface_default: Some(state.ctx.config.ndl.interface.are_default()),
            udp: ndl.udp,
            gncl: ndl.gncl,
            group: groups.first().cloned(),
            groups,
            seeds: state.ctx.config.ndl.seeds.iter().take(LISTED_MAX).map(ToString::to_string).collect(),
            sources: ndl.sources,
            lost: ndl.lost,
            lost_left_out: 0,
            own_stalls: Some(ndl.stalls),
            troubled: ndl.troubled,
            troubles: ndl.troubles,
            idle_clients: ndl.idle_clients,
            idle: ndl.idle,
            foreign: ndl.foreign,
            foreign_left_out: 0,
            refusals,
            refusals_left_out,
            unhandled: refused::unhandled(state, now),
            unguarded: refused::unguarded(state, now),
            lost_echoes: refused::lost_echoes(state, now),
            real_time: state.real_time.report(),
            recording: Some(state.recording.report_state()),
            retained: Some(state.ctx.router.retained().into()),
            stop: Some(state.ctx.router.stop().read().state()),
            guards,
            guards_left_out,
            peers,
            left_out,
        })
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn apps(&self, state: &Arc<NodeState>) -> Result<AppsReport, Rejection> {
        let (now, sync) = (Time::now(), lock(&state.sync.core));
        let (apps, more) = sync.own_apps(now, APPS_MAX);
        let barriers = sync.barriers(now);
        drop(sync);
        let registry = lock(&state.lncl.registry);
        let name_of = |kind| registry.kind_name(kind).map(str::to_owned);
        let apps = apps.into_iter().map(|app| app_report(state.ctx.node, app, name_of)).collect();
        drop(registry);
        // spec: INSPECT-3
        let barriers_left_out = barriers.len().saturating_sub(LISTED_MAX) as u64;
        let barriers = barriers.into_iter().take(LISTED_MAX).map(barrier_report).collect();
        let (groups, groups_left_out) = reach::groups(state);
        Ok(AppsReport {
            name: state.ctx.config.name.clone(),
            apps,
            left_out: more as u64,
            barriers,
            barriers_left_out,
            groups,
            groups_left_out,
        })
    }

    pub(super) fn tree(&self, state: &Arc<NodeState>) -> Result<TreeReport, Rejection> {
        let tree = NodeHandle::of(state.clone()).tree_within(ROOT_WITHIN).map_err(|why| {
            if matches!(why, CommandError::Busy) { Rejection::QueueFull } else { Rejection::Closed }
        })?;
        let mut lines = Vec::new();
        tree.supervisors.iter().for_each(|top| add_lines(&mut lines, 0, top));
        let left_out = lines.len().saturating_sub(TREE_MAX) as u64;
        lines.truncate(TREE_MAX);
        Ok(TreeReport { name: tree.node, lines, left_out })
    }

    /// Returns the messages that a watcher has not fetched yet, with the names of their types.
    pub(super) fn seen(&self, state: &NodeState, fetched: Fetched) -> WatchReport {
        let Fetched { messages, dropped, more } = fetched;
        let now = Time::now();
        let registry = lock(&state.lncl.registry);
        let seen = messages.into_iter().map(|message| {
            let name = registry.kind_name(message.header.kind).map(str::to_owned);
            seen_message(now, message, name)
        });
        WatchReport { seen: seen.collect(), dropped, more, refused: None }
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn audit(&self, state: &Arc<NodeState>) -> Result<AuditReport, Rejection> {
        Ok(AuditReport { audit: audit::read(state) })
    }
}

pub(super) fn security(state: &NodeState, clock: UnixTime) -> SecurityReport {
    let certificate = state.security.secured.get().map(|secured| CertificateReport {
        from_s: secured.validity.from.as_secs(),
        until_s: secured.validity.until.as_secs(),
        clock_s: clock.as_secs(),
        times: state.ctx.config.security.times.word().to_owned(),
        is_revoked: secured.tls.denied().has(&secured.serial),
    });
    SecurityReport { is_beyond_host: state.ctx.config.is_beyond_host(), certificate }
}

fn trouble(part: &TroubledApp) -> TroubleReport {
    let word = match part.trouble {
        Trouble::Stalled => "stalled",
        Trouble::Down => "away",
        Trouble::GivenUp => "given up",
        Trouble::Unheard => "not heard",
    };
    let TroubledApp { app, ref name, since, .. } = *part;
    TroubleReport { app, name: name.clone(), trouble: word.to_owned(), since_us: micros(since) }
}

fn idle(client: &IdleApp) -> IdleReport {
    let IdleApp { app, ref name, since } = *client;
    IdleReport { app, name: name.clone(), since_us: micros(since) }
}

fn barrier_report(status: BarrierStatus) -> BarrierReport {
    let BarrierStatus { barrier, parties, kind, generation, waiting, missing } = status;
    let wait = |(name, waits)| WaitReport { name, waits_us: micros(waits) };
    let waiting_left_out = waiting.len().saturating_sub(MISSING_MAX) as u64;
    let (missing, missing_left_out) = missing_reports(missing);
    BarrierReport {
        name: barrier,
        parties: parties.into_iter().take(MISSING_MAX).collect(),
        is_phase: kind == BarrierKind::Phase,
        generation,
        waiting: waiting.into_iter().take(MISSING_MAX).map(wait).collect(),
        waiting_left_out,
        missing,
        missing_left_out,
    }
}

/// Returns as many entries as fit into a report, and the number of further ones. spec: INSPECT-3
fn missing_reports(absences: Vec<Absence>) -> (Vec<Missing>, u64) {
    let left_out = absences.len().saturating_sub(MISSING_MAX) as u64;
    let report = |Absence { name, why, since }| Missing {
        name,
        why: Cow::into_owned(why),
        since_us: Some(micros(since)),
    };
    (absences.into_iter().take(MISSING_MAX).map(report).collect(), left_out)
}

fn seen_message(now: Time, message: Observed, name: Option<String>) -> SeenMessage {
    let Observed { at, way, header, length, payload, refused } = message;
    let wants = [(Flags::ASK, "ask"), (Flags::REPLY, "reply"), (Flags::CONFIRM, "confirm")];
    let wants = wants.into_iter().find(|(flag, _)| header.flags.has(*flag));
    SeenMessage {
        seen_us: micros(now.since(at)),
        age_ns: header.age(at).map(nanos),
        age_error_ns: header.sent_error().map(nanos),
        is_sent: way == Way::Out,
        source: header.source,
        target: header.destination,
        kind: header.kind,
        name,
        class: header.class,
        sequence: header.sequence,
        wants: wants.map(|(_, word)| word.to_owned()),
        length: length as u64,
        payload,
        refused,
    }
}

/// Returns the outputs that applications of this node guard in this process, and the number of further ones. Other
/// nodes may live in the same process.
fn guards(node: NodeAddress) -> (Vec<GuardReport>, u64) {
    let mut outputs = outputs();
    outputs.retain(|output| output.data_id.destination.node == node);
    let left_out = outputs.len().saturating_sub(LISTED_MAX) as u64;
    let report = |OutputState { data_id, state, is_safe_failed, .. }| GuardReport {
        receiver: data_id.destination,
        sender: data_id.source,
        kind_name: data_id.name.to_owned(),
        safe: match state {
            State::Live => None,
            State::Safe(cause) => Some(format!("{cause:?}")),
        },
        is_safe_failed,
    };
    (outputs.into_iter().take(LISTED_MAX).map(report).collect(), left_out)
}

fn app_report(node: NodeAddress, app: OwnApp, name_of: impl Fn(Kind) -> Option<String>) -> AppReport {
    let kinds = app.kinds.into_iter().map(|kind| KindReport { kind, name: name_of(kind) });
    let (missing, missing_left_out) = missing_reports(app.missing);
    AppReport {
        tid: Tid::new(node, app.app),
        name: app.name,
        ready: app.ready,
        waits_us: app.waits.map(micros),
        missing,
        missing_left_out,
        ended: app.ended.map(str::to_owned),
        kinds: kinds.collect(),
        kinds_left_out: 0,
    }
}

/// A tree has as many lines as the node has actors; its length is limited before it is sent.
fn add_lines(lines: &mut Vec<TreeLine>, depth: u32, one: &Supervised) {
    lines.push(TreeLine {
        depth,
        name: one.name.clone(),
        tid: one.tid,
        state: one.state.to_string(),
        since_us: micros(one.since),
        life: one.generation,
        restarts: one.restarts,
        last_reason: one
            .last_reason
            .as_ref()
            .map(|reason| reason.to_string().chars().take(TEXT_MAX).collect()),
        place: one.place.clone(),
        waiting: one.mailbox.map(|mailbox| mailbox.depth as u64),
        waiting_most: one.mailbox.map(|mailbox| mailbox.high_water as u64),
        oldest_us: one.mailbox.and_then(|mailbox| mailbox.oldest).map(micros),
        ages: one.mailbox.and_then(|mailbox| ages(&mailbox.ages)),
        strategy: one.supervises.as_ref().map(|below| strategy(below.flags.strategy).to_owned()),
    });
    for child in one.supervises.iter().flat_map(|below| &below.children) {
        add_lines(lines, depth + 1, child);
    }
}

/// Returns the ages, if there are any.
fn ages(ages: &MessageAges) -> Option<AgesReport> {
    let is_any = ages.counts.iter().any(|count| *count > 0);
    is_any.then(|| AgesReport { counts: ages.counts.to_vec(), sum_us: ages.sum_ns / 1_000 })
}

const fn strategy(strategy: Strategy) -> &'static str {
    match strategy {
        Strategy::OneForOne => "one-for-one",
        Strategy::RestForOne => "rest-for-one",
        Strategy::OneForAll => "one-for-all",
    }
}

pub(super) fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
