//! Any answer to an audit, against what is promised.

use std::collections::BTreeMap;

use bytes::Bytes;
use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::{Audit, NodeAudit, words};

pub(crate) fn said() -> Vec<Vec<u8>> {
    let audit = NodeAudit {
        node: NodeAddress::new(1),
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        entries: Vec::new(),
        sessions: Vec::new(),
        refused: BTreeMap::new(),
    };
    words::write(&audit, usize::MAX).into_iter().map(|bytes| bytes.to_vec()).collect()
}

pub(crate) fn words(bytes: &[u8]) -> bool {
    let Ok(said) = words::read(&Bytes::copy_from_slice(bytes)) else { return false };
    let before = std::slice::from_ref(&said);
    let audit = Audit::of(said.node, before, vec![said.clone()], Vec::new());
    let _ = audit.to_string();
    true
}
