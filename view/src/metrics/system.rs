//! The metrics of `sinew view` itself, and of each node as a whole.

use sinew::{Time, stop::StopState};

use super::{
    samples::Samples,
    table::{
        AGE, ENTRY_UP, FOXGLOVE_CLIENTS, FOXGLOVE_DROPPED, FOXGLOVE_MESSAGES, LEFT_OUT, NODE_FIFO,
        NODE_IDLE_CLIENTS, NODE_LATENESS, NODE_LOST, NODE_MEMORY, NODE_STALL_LONGEST, NODE_STALLS,
        NODE_STOPPED, NODE_STOPPING, NODE_TROUBLED, NODE_UP, NODE_UPTIME, RECORDER_DROPPED, RECORDER_SEEN,
        REFUSED, RETAINED_BYTES, RETAINED_DROPPED, RETAINED_VALUES, TOOK,
    },
};
use crate::{
    foxglove::Counts,
    nodes::{NodeRow, State, bounded},
    snapshot::{Answers, Snapshot},
};

/// Maximum number of causes of refusals of a node. Further ones are added up as `other`.
const CAUSES_MAX: usize = 64;

/// Returns a truth as a level.
pub(super) fn truth(is_so: bool) -> f64 {
    f64::from(u8::from(is_so))
}

/// Returns microseconds as seconds.
pub(super) fn micros(micros: u64) -> f64 {
    micros as f64 / 1e6
}

/// Adds the counters of the server for Foxglove.
pub(super) fn add_foxglove(samples: &mut Samples, counts: Counts) {
    let Counts { clients, queued, dropped, missed } = counts;
    samples.level(&FOXGLOVE_CLIENTS, [], clients as f64);
    samples.count(&FOXGLOVE_MESSAGES, [], queued);
    samples.count(&FOXGLOVE_DROPPED, ["client"], dropped);
    samples.count(&FOXGLOVE_DROPPED, ["journal"], missed);
}

/// Adds the state of the snapshot and of each node of the system.
pub(super) fn add(samples: &mut Samples, snapshot: &Snapshot, rows: &[NodeRow], now: Time) {
    samples.level(&ENTRY_UP, [], truth(snapshot.entry.is_ok()));
    samples.level(&AGE, [], now.since(snapshot.taken).as_secs_f64());
    samples.level(&TOOK, [], snapshot.took.as_secs_f64());
    for NodeRow { label, state, .. } in rows {
        samples.level(&NODE_UP, [label], truth(matches!(state, State::Up | State::Stops)));
        if let State::Lost(class, _) = state {
            samples.level(&NODE_LOST, [label, class], 1.0);
        }
    }
    if let Ok(entry) = &snapshot.entry {
        let label = rows.iter().find(|row| row.node == entry.node);
        let label = label.map_or_else(|| entry.node.to_string(), |row| row.label.clone());
        let nodes = snapshot.left_out.saturating_add(entry.left_out);
        samples.level(&LEFT_OUT, [&label, "nodes"], nodes as f64);
        samples.level(&LEFT_OUT, [&label, "lost nodes"], entry.lost_left_out as f64);
    }
}

/// Adds the report of a node about itself.
pub(super) fn add_node(samples: &mut Samples, answers: &Answers, label: &str) {
    let Answers { node, apps, tree, audit, .. } = answers;
    samples.level(&NODE_STOPPING, [label], truth(node.stopping));
    samples.level(&NODE_UPTIME, [label], micros(node.up_us));
    samples.level(&NODE_TROUBLED, [label], node.troubled.into());
    samples.level(&NODE_IDLE_CLIENTS, [label], node.idle_clients.into());
    if let Some(stalls) = node.own_stalls {
        samples.count(&NODE_STALLS, [label], stalls.count);
        samples.level(&NODE_STALL_LONGEST, [label], micros(stalls.longest_us));
    }
    if let Some(stop) = node.stop {
        samples.level(&NODE_STOPPED, [label], truth(stop == StopState::Stopped));
    }
    if let Some(measured) = &node.real_time {
        samples.level(&NODE_FIFO, [label], measured.granted.into());
        samples.level(&NODE_MEMORY, [label], truth(measured.memory == "locked"));
        let quantiles = [
            ("0.5", measured.p50_ns),
            ("0.99", measured.p99_ns),
            ("0.999", measured.p999_ns),
            ("1", measured.max_ns),
        ];
        for (quantile, nanos) in quantiles {
            samples.level(&NODE_LATENESS, [label, quantile], nanos as f64 / 1e9);
        }
    }
    if let Some(recording) = &node.recording {
        samples.count(&RECORDER_SEEN, [label], recording.seen);
        samples.count(&RECORDER_DROPPED, [label], recording.dropped);
    }
    if let Some(retained) = &node.retained {
        samples.level(&RETAINED_VALUES, [label], retained.values as f64);
        samples.level(&RETAINED_BYTES, [label], retained.bytes as f64);
        samples.count(&RETAINED_DROPPED, [label, "bound"], retained.not_kept);
        samples.count(&RETAINED_DROPPED, [label, "member"], retained.not_handed_over);
    }
    samples.level(&LEFT_OUT, [label, "applications"], apps.left_out as f64);
    samples.level(&LEFT_OUT, [label, "barriers"], apps.barriers_left_out as f64);
    samples.level(&LEFT_OUT, [label, "guards"], node.guards_left_out as f64);
    samples.level(&LEFT_OUT, [label, "supervised"], tree.left_out as f64);
    for (number, (cause, count)) in audit.refused.iter().enumerate() {
        let cause = if number < CAUSES_MAX { bounded(cause) } else { "other".to_owned() };
        samples.count(&REFUSED, [label, &cause], *count);
    }
}
