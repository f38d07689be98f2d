//! Checks arbitrary answers to an audit against the promised properties.

use std::collections::BTreeMap;

use bytes::Bytes;
use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::{Audit, NodeAudit, protocol};

pub fn sent_frames() -> Vec<Vec<u8>> {
    let audit = NodeAudit {
        node: NodeAddress::new(1),
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        entries: Vec::new(),
        sessions: Vec::new(),
        refused: BTreeMap::new(),
    };
    protocol::write(&audit, usize::MAX).into_iter().map(|bytes| bytes.to_vec()).collect()
}

pub fn frames(bytes: &[u8]) -> bool {
    let Ok(report) = protocol::read(&Bytes::copy_from_slice(bytes)) else { return false };
    let before = std::slice::from_ref(&report);
    let audit = Audit::of(report.node, before, vec![report.clone()], Vec::new());
    let _ = audit.to_string();
    true
}
