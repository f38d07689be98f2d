//! Checks whether two nodes use different versions of the protocol.

use sinew::inspect::NodeReport;

use super::speaks_of;
use crate::table::time;

/// Returns a refusal by either node because of the other's version.
pub(super) fn differs(a: &NodeReport, b: &NodeReport) -> Option<(String, String)> {
    refused(a, b).or_else(|| refused(b, a))
}

fn refused(at: &NodeReport, of: &NodeReport) -> Option<(String, String)> {
    let node = of.node.to_string();
    let is_meant =
        |detail: &str| speaks_of(detail, &node) || of.udp.as_ref().is_some_and(|udp| speaks_of(detail, udp));
    let refusal =
        at.refusals.iter().find(|refusal| refusal.cause.ends_with("version") && is_meant(&refusal.detail))?;
    let detail = format!(
        "{} (Sinew {}) refused the protocol version of {} (Sinew {}) {} ago: {}",
        at.name,
        at.version,
        of.name,
        of.version,
        time(refusal.ago_us),
        refusal.detail
    );
    Some((detail, "run the same version of Sinew on both; update the older one".to_owned()))
}
