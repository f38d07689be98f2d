//! The metrics of a node about each other node that it knows: liveness, clock, connections.

use sinew::inspect::{LinkReport, NodeReport, PeerReport};

use super::{
    samples::Samples,
    system::{micros, truth},
    table::{
        CLOCK_DRIFT, CLOCK_DRIFT_BOUND, CLOCK_OFFSET, CLOCK_OFFSET_BOUND, DATAGRAMS_ACKED, DATAGRAMS_SENT,
        DIALS_FAILED, LINK_DEPTH, LINK_UNCONFIRMED, LINK_UP, Metric, PEER_LOSS_BOUND, PEER_MISSED,
        PEER_ROUND_TRIP, PEER_SILENT, PEER_UP,
    },
};
use crate::nodes::{NodeLabels, bounded};

/// Adds the peers of a node.
pub(super) fn add(samples: &mut Samples, report: &NodeReport, node: &str, labels: &NodeLabels) {
    for peer in &report.peers {
        add_peer(samples, peer, [node, &labels.get(peer.node)]);
    }
}

fn add_peer(samples: &mut Samples, peer: &PeerReport, labels: [&str; 2]) {
    samples.level(&PEER_UP, labels, truth(peer.is_there));
    samples.level(&PEER_MISSED, labels, peer.missed.into());
    samples.level(&DIALS_FAILED, labels, peer.dial.as_ref().map_or(0, |dial| dial.failed) as f64);
    let mut some = |metric: &Metric, level: Option<f64>| {
        if let Some(level) = level {
            samples.level(metric, labels, level);
        }
    };
    some(&PEER_SILENT, peer.silent_us.map(micros));
    some(&PEER_LOSS_BOUND, peer.bound_us.map(micros));
    some(&PEER_ROUND_TRIP, peer.round_trip_ns.map(|nanos| nanos as f64 / 1e9));
    some(&CLOCK_OFFSET, peer.offset_ns.map(|nanos| nanos as f64 / 1e9));
    some(&CLOCK_OFFSET_BOUND, peer.offset_bound_ns.map(|nanos| nanos as f64 / 1e9));
    some(&CLOCK_DRIFT, peer.drift_ppb.map(|ppb| ppb as f64 / 1e9));
    some(&CLOCK_DRIFT_BOUND, peer.drift_bound_ppb.map(|ppb| ppb as f64 / 1e9));
    if let Some(stream) = &peer.stream {
        samples.count(&DATAGRAMS_SENT, labels, stream.sent);
        samples.count(&DATAGRAMS_ACKED, labels, stream.arrived);
    }
    let [node, peer_label] = labels;
    for LinkReport { class, is_up, waiting, unconfirmed } in &peer.links {
        let labels = [node, peer_label, &bounded(&class.to_lowercase())];
        samples.level(&LINK_UP, labels, truth(*is_up));
        samples.level(&LINK_DEPTH, labels, *waiting as f64);
        samples.level(&LINK_UNCONFIRMED, labels, *unconfirmed as f64);
    }
}
