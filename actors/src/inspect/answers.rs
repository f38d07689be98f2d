//! What a node says about itself: reads its stores, and asks the root for the tree.

use std::{
    borrow::Cow,
    collections::BTreeMap,
    sync::{Arc, Weak, atomic::Ordering},
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::tap::Way,
    supervision::Strategy,
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Flags, Kind},
};

use super::reports::{
    APPS_MAX, AppReport, AppsReport, AuditReport, BarrierReport, CertificateReport, DialReport,
    ForeignReport, IdleReport, KindReport, LinkReport, LostReport, MISSING_MAX, Missing, NodeReport,
    PEERS_MAX, PeerReport, RefusalReport, RouteReport, SecurityReport, SeenMessage, SourceReport,
    StallReport, StreamReport, TOLD_MAX, TREE_MAX, TreeLine, TreeReport, TroubleReport, UnhandledReport,
    WaitReport, WatchReport,
};
use super::watches::{Fetched, Sight};
use crate::{
    audit,
    gncl::{self, ByDatagram, Peer},
    ndl::{IdleApp, KnownNode, KnownRoute, LossReason, LostNode, Source, SourceCounts, Trouble, TroubledApp},
    node::{CommandError, NodeHandle, Supervised},
    security::UnixTime,
    stores::{Stores, lock},
    sync::{Absence, BarrierKind, BarrierStatus, OwnApp},
    undelivered,
};

/// Time for the root's answer: one that hangs does not keep the other questions waiting for long.
const ROOT_WITHIN: Duration = Duration::from_secs(1);
/// Longest text that an application has chosen, in characters: the words of a panic.
const TEXT_MAX: usize = 256;

/// What the answers are made from.
pub(super) struct Answers {
    /// Not kept alive by this.
    stores: Weak<Stores>,
    began: Time,
}

impl Answers {
    pub(super) const fn new(stores: Weak<Stores>, began: Time) -> Self {
        Self { stores, began }
    }

    /// `None` when the node has ended.
    pub(super) fn stores(&self) -> Option<Arc<Stores>> {
        self.stores.upgrade()
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn node(&self, stores: &Arc<Stores>) -> Result<NodeReport, Rejection> {
        let now = Time::now();
        let mut peers: Vec<_> = peers(stores, now).into_values().collect();
        let left_out = peers.len().saturating_sub(PEERS_MAX) as u64;
        peers.truncate(PEERS_MAX);
        let (mut room, mut idle_room) = (TOLD_MAX, TOLD_MAX);
        for peer in &mut peers {
            peer.troubles.truncate(room);
            room -= peer.troubles.len();
            peer.idle.truncate(idle_room);
            idle_room -= peer.idle.len();
        }
        let (ndl, groups) = (Discovery::of(stores, now), stores.config.ndl.asked_groups());
        let (refusals, refusals_left_out) = refusals(stores, now);
        Ok(NodeReport {
            node: stores.node,
            name: stores.config.name.clone(),
            incarnation: stores.incarnation,
            up_us: micros(now.since(self.began)),
            pid: std::process::id(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            stopping: stores.stopping.load(Ordering::Relaxed),
            refused: NodeHandle::of(stores.clone()).refused(),
            project: stores.config.project.clone(),
            security: Some(security(stores, UnixTime::now())),
            interface: stores.config.ndl.interface.to_string(),
            is_interface_default: Some(stores.config.ndl.interface.are_default()),
            udp: ndl.udp,
            gncl: ndl.gncl,
            group: groups.first().cloned(),
            groups,
            seeds: stores.config.ndl.seeds.iter().take(TOLD_MAX).map(ToString::to_string).collect(),
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
            unhandled: unhandled(stores, now),
            peers,
            left_out,
        })
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn apps(&self, stores: &Arc<Stores>) -> Result<AppsReport, Rejection> {
        let (now, sync) = (Time::now(), lock(&stores.sync));
        let (apps, more) = sync.own_apps(now, APPS_MAX);
        let barriers = sync.barriers(now);
        drop(sync);
        let registry = lock(&stores.registry);
        let name_of = |kind| registry.kind_name(kind).map(str::to_owned);
        let apps = apps.into_iter().map(|app| app_report(stores.node, app, name_of)).collect();
        drop(registry);
        // spec: INSPECT-3
        let barriers_left_out = barriers.len().saturating_sub(TOLD_MAX) as u64;
        let barriers = barriers.into_iter().take(TOLD_MAX).map(barrier_report).collect();
        let name = stores.config.name.clone();
        Ok(AppsReport { name, apps, left_out: more as u64, barriers, barriers_left_out })
    }

    pub(super) fn tree(&self, stores: &Arc<Stores>) -> Result<TreeReport, Rejection> {
        let tree = NodeHandle::of(stores.clone()).tree_within(ROOT_WITHIN).map_err(|why| {
            if matches!(why, CommandError::Busy) { Rejection::QueueFull } else { Rejection::Closed }
        })?;
        let mut lines = Vec::new();
        tree.supervisors.iter().for_each(|top| add_lines(&mut lines, 0, top));
        let left_out = lines.len().saturating_sub(TREE_MAX) as u64;
        lines.truncate(TREE_MAX);
        Ok(TreeReport { name: tree.node, lines, left_out })
    }

    /// What a watcher has not seen yet, with the names of the types.
    pub(super) fn seen(&self, stores: &Stores, fetched: Fetched) -> WatchReport {
        let Fetched { sights, dropped, more } = fetched;
        let now = Time::now();
        let registry = lock(&stores.registry);
        let seen = sights.into_iter().map(|sight| {
            let name = registry.kind_name(sight.header.kind).map(str::to_owned);
            seen_message(now, sight, name)
        });
        WatchReport { seen: seen.collect(), dropped, more, refused: None }
    }

    #[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
    pub(super) fn audit(&self, stores: &Arc<Stores>) -> Result<AuditReport, Rejection> {
        Ok(AuditReport { audit: audit::read(stores) })
    }
}

pub(super) fn security(stores: &Stores, clock: UnixTime) -> SecurityReport {
    let certificate = stores.secured.get().map(|secured| CertificateReport {
        from_s: secured.validity.from.as_secs(),
        until_s: secured.validity.until.as_secs(),
        clock_s: clock.as_secs(),
        times: stores.config.security.times.word().to_owned(),
        is_revoked: secured.tls.denied().has(&secured.serial),
    });
    SecurityReport { is_beyond_host: stores.config.is_beyond_host(), certificate }
}

/// What NDL says of itself, and of those that are no members.
struct Discovery {
    udp: Option<String>,
    gncl: Option<String>,
    sources: Vec<SourceReport>,
    lost: Vec<LostReport>,
    foreign: Vec<ForeignReport>,
    stalls: StallReport,
    troubled: u32,
    troubles: Vec<TroubleReport>,
    idle_clients: u32,
    idle: Vec<IdleReport>,
}

impl Discovery {
    fn of(stores: &Stores, now: Time) -> Self {
        let core = lock(&stores.ndl);
        let (udp, me) = (core.paths().first().copied(), core.announcement().clone());
        let (sources, lost, foreign) = (core.source_counts(), core.lost_nodes(), core.neighbours());
        let (stalls, (troubled, troubled_apps)) = (core.own_stalls(), core.own_troubles());
        let (idle_clients, idle_apps) = core.own_idle();
        drop(core);
        let stalls = StallReport {
            count: stalls.count,
            longest_us: micros(stalls.longest),
            last_us: stalls.last.map(|last| micros(now.since(last))),
        };
        let mut lost: Vec<_> = lost.into_iter().map(|(node, lost)| lost_report(node, lost, now)).collect();
        lost.sort_by_key(|lost| lost.lost_us);
        let foreign = foreign.into_iter().map(|(from, other)| ForeignReport {
            node: other.node,
            name: other.name,
            project: other.project,
            udp: from.to_string(),
            ago_us: micros(now.since(other.heard)),
        });
        let gncl = udp.and_then(|udp| me.gncl_addresses(None, [(udp, udp)]).first().map(ToString::to_string));
        let source = |(source, SourceCounts { places, members })| SourceReport {
            source: Source::name(source).to_owned(),
            is_on: is_on(stores, source),
            places: places as u64,
            found: members as u64,
        };
        let sources = sources.into_iter().map(source).collect();
        Self {
            udp: udp.map(|udp| udp.to_string()),
            gncl,
            sources,
            lost,
            foreign: foreign.collect(),
            stalls,
            troubled: u32::try_from(troubled).unwrap_or(u32::MAX),
            troubles: troubled_apps.iter().map(trouble).collect(),
            idle_clients: u32::try_from(idle_clients).unwrap_or(u32::MAX),
            idle: idle_apps.iter().map(idle).collect(),
        }
    }
}

/// Whether the configuration lets a source of addresses say anything.
fn is_on(stores: &Stores, source: Source) -> bool {
    let config = &stores.config;
    match source {
        Source::Seed => !config.ndl.seeds.is_empty(),
        Source::Multicast => config.ndl.multicast.is_some(),
        Source::Mdns => config.ndl.mdns_port.is_some(),
        Source::Query => true,
        Source::Remembered => config.state.is_some(),
    }
}

fn lost_report(node: NodeAddress, lost: LostNode, now: Time) -> LostReport {
    let why = match lost.why {
        LossReason::GaveUp(words) => &format!("gave up: {words}"),
        LossReason::Left => "left",
        LossReason::Crashed => "crashed",
        LossReason::Hung => "hung",
        LossReason::LinkDown => "link down",
        LossReason::Restarted => "restarted",
        LossReason::Duplicate => "duplicate",
    };
    LostReport {
        node,
        name: lost.name,
        incarnation: lost.incarnation,
        udp: lost.address.to_string(),
        lost_us: micros(now.since(lost.lost)),
        why: why.to_owned(),
        silent_us: micros(lost.silent),
        bound_us: Some(micros(lost.bound)),
        found_by: lost.sources.iter().map(|source| source.name().to_owned()).collect(),
    }
}

/// Of NDL, GNCL and the other layers: what came from outside and was refused, and how many further causes have no room. spec: INSPECT-3
fn refusals(stores: &Stores, now: Time) -> (Vec<RefusalReport>, u64) {
    let told = [lock(&stores.ndl).refusals().told(), stores.gncl.refusals.told(), stores.refusals.told()];
    let mut told: Vec<_> = told.into_iter().flatten().collect();
    told.sort_by_key(|told| std::cmp::Reverse(told.at));
    let left_out = told.len().saturating_sub(TOLD_MAX) as u64;
    let reports = told.into_iter().take(TOLD_MAX).map(|told| RefusalReport {
        cause: told.cause.to_owned(),
        count: told.count,
        detail: told.detail,
        ago_us: micros(now.since(told.at)),
    });
    (reports.collect(), left_out)
}

/// Types that applications of this node did not handle or could not read, and those of this node's that others did not.
fn unhandled(stores: &Stores, now: Time) -> Vec<UnhandledReport> {
    let here = stores.undelivered.unhandled().into_iter();
    let here = here.map(|((app, kind, why), line)| {
        (Tid::new(stores.node, app), line.about, kind, why, line.count, line.last)
    });
    // Refused by other nodes: the sender's node alone knows the name of the type.
    let there = stores.undelivered.unhandled_elsewhere().into_iter();
    let there = there.map(|((app, to, kind, why), line)| {
        (to, Tid::new(stores.node, app), kind, why, line.count, line.last)
    });
    let reports = here.chain(there).take(TOLD_MAX).map(|(receiver, sender, kind, why, count, last)| {
        let is_malformed = why == Outcome::Rejected(Rejection::Malformed).code();
        let remedy = if is_malformed {
            "use the same type at both ends; the log of the receiver names the field".to_owned()
        } else {
            undelivered::remedy(receiver.app, kind)
        };
        UnhandledReport {
            receiver,
            sender,
            kind,
            kind_name: undelivered::kind_name(stores, kind),
            is_malformed,
            count,
            ago_us: micros(now.since(last)),
            remedy,
        }
    });
    reports.collect()
}

/// Those that answer, and those that GNCL still has something for.
fn peers(stores: &Stores, now: Time) -> BTreeMap<NodeAddress, PeerReport> {
    let known = lock(&stores.ndl).members(now);
    let mut peers: BTreeMap<_, _> = known.iter().map(|known| (known.node, peer_report(known, now))).collect();
    for peer in stores.gncl.peers() {
        let lost = || PeerReport::lost(peer.node, peer.incarnation);
        let report = peers.entry(peer.node).or_insert_with(lost);
        (report.links, report.stream) = (links(&peer), stream(stores, &peer));
    }
    for (node, peer) in &mut peers {
        let note = stores.gncl.notes.of(*node);
        peer.linked_us = note.linked.map(|at| micros(now.since(at)));
        peer.broken_us = note.broken.map(|at| micros(now.since(at)));
        peer.dial = note.dial.map(|dial| DialReport {
            address: dial.address.to_string(),
            error: dial.error,
            fault: dial.fault.word().to_owned(),
            ago_us: micros(now.since(dial.at)),
            failed: dial.count,
        });
    }
    peers
}

fn peer_report(known: &KnownNode, now: Time) -> PeerReport {
    PeerReport {
        name: Some(known.name.clone()),
        is_there: true,
        found_us: Some(micros(now.since(known.since))),
        found_by: known.sources.keys().map(|source| source.name().to_owned()).collect(),
        silent_us: Some(micros(now.since(known.heard))),
        missed: known.missed,
        asked_every_us: Some(micros(known.asked_every)),
        bound_us: Some(micros(known.bound)),
        troubled: u32::try_from(known.troubled).unwrap_or(u32::MAX),
        troubles: known.troubles.iter().map(trouble).collect(),
        idle_clients: u32::try_from(known.idle_clients).unwrap_or(u32::MAX),
        idle: known.idle.iter().map(idle).collect(),
        routes: known.routes.iter().map(route).collect(),
        round_trip_ns: known.round_trip.map(nanos),
        offset_ns: known.offset.map(|offset| offset.theirs_minus_ours_ns),
        offset_bound_ns: known.offset.map(|offset| nanos(offset.bound)),
        drift_ppb: known.offset.map(|offset| offset.drift.ppb),
        drift_bound_ppb: known.offset.map(|offset| offset.drift.bound_ppb),
        ..PeerReport::lost(known.node, known.incarnation)
    }
}

fn route(of: &KnownRoute) -> RouteReport {
    let KnownRoute { here, there, missed, round_trip } = of;
    RouteReport {
        here: here.to_string(),
        there: there.to_string(),
        missed: *missed,
        round_trip_ns: round_trip.map(nanos),
    }
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

fn links(peer: &Peer) -> Vec<LinkReport> {
    let names: &[&str] = if peer.ways().len() == 1 { &["all"] } else { &["control", "stream", "bulk"] };
    let links = names.iter().zip(peer.ways()).map(|(class, way)| LinkReport {
        class: (*class).to_owned(),
        is_up: way.outlet.is_connected(),
        waiting: way.outlet.waiting() as u64,
        unconfirmed: way.outlet.unconfirmed() as u64,
    });
    links.collect()
}

fn stream(stores: &Stores, peer: &Peer) -> Option<StreamReport> {
    let has_a_connection = peer.ways().len() > 1;
    has_a_connection.then(|| {
        let by_datagram = gncl::by_datagram(peer);
        let ByDatagram { sent, arrived, payload_max } = by_datagram.unwrap_or_default();
        let is_on = stores.config.gncl.datagrams;
        let payload_max = payload_max.map(|bytes| bytes as u64);
        StreamReport { is_on, is_agreed: by_datagram.is_some(), sent, arrived, payload_max }
    })
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

/// As many as a report has room for, and how many more there are. spec: INSPECT-3
fn missing_reports(absences: Vec<Absence>) -> (Vec<Missing>, u64) {
    let left_out = absences.len().saturating_sub(MISSING_MAX) as u64;
    let report = |Absence { name, why, since }| Missing {
        name,
        why: Cow::into_owned(why),
        since_us: Some(micros(since)),
    };
    (absences.into_iter().take(MISSING_MAX).map(report).collect(), left_out)
}

fn seen_message(now: Time, sight: Sight, name: Option<String>) -> SeenMessage {
    let Sight { at, way, header, length, payload, refused } = sight;
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

/// A tree has as many lines as the node has actors; it is bounded before it is sent.
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
        strategy: one.supervises.as_ref().map(|below| strategy(below.flags.strategy).to_owned()),
    });
    for child in one.supervises.iter().flat_map(|below| &below.children) {
        add_lines(lines, depth + 1, child);
    }
}

const fn strategy(strategy: Strategy) -> &'static str {
    match strategy {
        Strategy::OneForOne => "one-for-one",
        Strategy::RestForOne => "rest-for-one",
        Strategy::OneForAll => "one-for-all",
    }
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{AppAddress, Incarnation};

    use super::*;

    #[test]
    fn a_peer_is_told_with_when_it_was_found_its_pace_its_bound_and_what_of_it_does_not_get_on() {
        let now = Time::ZERO + Duration::from_secs(9);
        let node = NodeAddress::new(7);
        let app = Tid::new(node, AppAddress::new(0x1000));
        let (trouble, since) = (Trouble::GivenUp, Duration::from_millis(3));
        let known = KnownNode {
            node,
            name: "knee".to_owned(),
            incarnation: Incarnation(1),
            udp: ([10, 0, 0, 7], 1).into(),
            routes: Vec::new(),
            gncl: Vec::new(),
            period: Duration::from_secs(1),
            since: now - Duration::from_secs(2),
            // Its address was known before it was there.
            sources: BTreeMap::from([(Source::Seed, Time::ZERO)]),
            heard: now,
            missed: 0,
            asked_every: Duration::from_millis(10),
            bound: Duration::from_millis(40),
            troubled: 5,
            troubles: vec![TroubledApp { app, name: "drive".to_owned(), trouble, since }],
            idle_clients: 3,
            idle: vec![IdleApp { app, name: "hand".to_owned(), since }],
            round_trip: None,
            offset: None,
        };
        let said = peer_report(&known, now);
        assert_eq!((said.found_us, said.found_by), (Some(2_000_000), vec!["seed".to_owned()]));
        assert_eq!((said.asked_every_us, said.bound_us, said.troubled), (Some(10_000), Some(40_000), 5));
        let (name, trouble) = ("drive".to_owned(), "given up".to_owned());
        assert_eq!(said.troubles, [TroubleReport { app, name, trouble, since_us: 3_000 }]);
        let hand = IdleReport { app, name: "hand".to_owned(), since_us: 3_000 };
        assert_eq!((said.idle_clients, said.idle), (3, vec![hand]));
    }
}
