//! The nodes that a node knows: their state by NDL, and their connections by GNCL.

use std::collections::BTreeMap;

use sinew_gncl::{DatagramShare, Peer};
use sinew_ndl::{KnownNode, KnownRoute};
use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use super::{idle, micros, nanos, trouble};
use crate::{
    NodeState,
    inspect::reports::{DialReport, LinkReport, PeerReport, RouteReport, StreamReport},
};

/// Returns the nodes that answer, and those for which GNCL still has messages.
pub(super) fn peers(state: &NodeState, now: Time) -> BTreeMap<NodeAddress, PeerReport> {
    let known = lock(&state.ndl.core).members(now);
    let mut peers: BTreeMap<_, _> = known.iter().map(|known| (known.node, peer_report(known, now))).collect();
    for peer in state.gncl.store.peers() {
        let lost = || PeerReport::lost(peer.node, peer.incarnation);
        let report = peers.entry(peer.node).or_insert_with(lost);
        (report.links, report.stream) = (links(&peer), stream(state, &peer));
    }
    for (node, peer) in &mut peers {
        let status = state.gncl.store.link_status.of(*node);
        peer.linked_us = status.linked.map(|at| micros(now.since(at)));
        peer.broken_us = status.broken.map(|at| micros(now.since(at)));
        peer.dial = status.dial.map(|dial| DialReport {
            address: dial.address.to_string(),
            error: dial.error,
            fault: dial.failure.name().to_owned(),
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
    let KnownRoute { here, interface, there, missed, round_trip } = of;
    RouteReport {
        here: here.to_string(),
        interface: interface.clone(),
        there: there.to_string(),
        missed: *missed,
        round_trip_ns: round_trip.map(nanos),
    }
}

fn links(peer: &Peer) -> Vec<LinkReport> {
    let names: &[&str] = if peer.sessions().len() == 1 { &["all"] } else { &["control", "stream", "bulk"] };
    let links = names.iter().zip(peer.sessions()).map(|(class, session)| LinkReport {
        class: (*class).to_owned(),
        is_up: session.outlet.is_connected(),
        waiting: session.outlet.waiting() as u64,
        unconfirmed: session.outlet.unconfirmed() as u64,
    });
    links.collect()
}

fn stream(state: &NodeState, peer: &Peer) -> Option<StreamReport> {
    let has_a_connection = peer.sessions().len() > 1;
    has_a_connection.then(|| {
        let share = sinew_gncl::datagram_share(peer);
        let DatagramShare { sent, arrived, payload_max } = share.unwrap_or_default();
        let is_on = state.ctx.config.gncl.datagrams;
        let payload_max = payload_max.map(|bytes| bytes as u64);
        StreamReport { is_on, is_agreed: share.is_some(), sent, arrived, payload_max }
    })
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew_model::facts::Trouble;
    use sinew_ndl::{IdleApp, Source, TroubledApp};
    use sinew_runtime::tid::{AppAddress, Incarnation, Tid};

    use super::*;
    use crate::inspect::reports::{IdleReport, TroubleReport};

    #[test]
    fn peer_is_reported_with_discovery_time_pace_and_troubles() {
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
            // Its address was known before the peer was present.
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
        let report = peer_report(&known, now);
        assert_eq!((report.found_us, report.found_by), (Some(2_000_000), vec!["seed".to_owned()]));
        assert_eq!(
            (report.asked_every_us, report.bound_us, report.troubled),
            (Some(10_000), Some(40_000), 5)
        );
        let (name, trouble) = ("drive".to_owned(), "given up".to_owned());
        assert_eq!(report.troubles, [TroubleReport { app, name, trouble, since_us: 3_000 }]);
        let hand = IdleReport { app, name: "hand".to_owned(), since_us: 3_000 };
        assert_eq!((report.idle_clients, report.idle), (3, vec![hand]));
    }
}
