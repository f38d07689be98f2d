//! Discovery as NDL reports it: its sources, the nodes that it lost, and the troubles of this node.

use sinew_model::facts::LossReason;
use sinew_ndl::{LostNode, Source, SourceCounts};
use sinew_runtime::{lock, tid::NodeAddress, time::Time};

use super::{idle, micros, trouble};
use crate::{
    NodeState,
    inspect::reports::{ForeignReport, IdleReport, LostReport, SourceReport, StallReport, TroubleReport},
};

/// NDL's report about itself and about nodes that are no members.
pub(super) struct Discovery {
    pub(super) udp: Option<String>,
    pub(super) gncl: Option<String>,
    pub(super) sources: Vec<SourceReport>,
    pub(super) lost: Vec<LostReport>,
    pub(super) foreign: Vec<ForeignReport>,
    pub(super) stalls: StallReport,
    pub(super) troubled: u32,
    pub(super) troubles: Vec<TroubleReport>,
    pub(super) idle_clients: u32,
    pub(super) idle: Vec<IdleReport>,
}

impl Discovery {
    pub(super) fn of(state: &NodeState, now: Time) -> Self {
        let core = lock(&state.ndl.core);
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
            ago_us: micros(now.since(other.last_seen)),
        });
        let gncl = udp.and_then(|udp| me.gncl_addresses(None, [(udp, udp)]).first().map(ToString::to_string));
        let source = |(source, SourceCounts { places, members })| SourceReport {
            source: Source::name(source).to_owned(),
            is_on: is_on(state, source),
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

/// Returns whether the configuration enables a discovery source.
fn is_on(state: &NodeState, source: Source) -> bool {
    let config = &state.ctx.config;
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
