//! The frames between nodes for an audit: a question without a payload, and its answer. This module bounds
//! the bytes from another node.

use std::collections::BTreeMap;

use bytes::Bytes;
use sinew_runtime::wire::decode;
use sinew_session::{counts::Account, place::Place};

use super::reading::{Entry, NodeAudit};

/// Maximum bytes of an answer, on both sides: more than 200 nodes with their sessions need.
pub(super) const ANSWER_BYTES_MAX: usize = 256 << 10;

/// Returns an answer of at most this many bytes; applications that do not fit are summed up. `None` if even
/// that is too long.
pub(super) fn write(audit: &NodeAudit, bytes_max: usize) -> Option<Bytes> {
    let mut audit = audit.clone();
    loop {
        let bytes = rmp_serde::to_vec_named(&audit).expect("these types have no map with equal keys");
        if bytes.len() <= bytes_max.min(ANSWER_BYTES_MAX) {
            return Some(bytes.into());
        }
        if !put_together(&mut audit) {
            return None;
        }
    }
}

/// Decodes an answer.
///
/// # Errors
/// Returns the reason if the bytes are invalid.
pub(super) fn read(bytes: &Bytes) -> Result<NodeAudit, String> {
    if bytes.len() > ANSWER_BYTES_MAX {
        return Err(format!("an audit of {} bytes; {ANSWER_BYTES_MAX} are read at most", bytes.len()));
    }
    decode(bytes).map_err(|error| format!("this is no audit: {error}"))
}

/// Sums up the accounts of half of the applications. Returns whether there were any.
pub(crate) fn put_together(audit: &mut NodeAudit) -> bool {
    let others = |place: &Place| match place {
        Place::Mailbox { .. } => Some(Place::OtherMailboxes),
        Place::Client { .. } => Some(Place::OtherClients),
        Place::DirectLink { .. } => Some(Place::OtherDirectLinks),
        Place::ToNode { .. }
        | Place::FromNode { .. }
        | Place::OtherMailboxes
        | Place::OtherClients
        | Place::OtherDirectLinks
        | Place::ToFormerNodes
        | Place::FromFormerNodes => None,
    };
    let mut left = audit.entries.iter().filter(|entry| others(&entry.place).is_some()).count().div_ceil(2);
    let had_any = left > 0;
    let mut kept: BTreeMap<Place, Account> = BTreeMap::new();
    // From the end, so that the first ones stay.
    for Entry { place, account } in std::mem::take(&mut audit.entries).into_iter().rev() {
        let place = match others(&place) {
            Some(other) if left > 0 => {
                left -= 1;
                other
            }
            Some(_) | None => place,
        };
        let entry = kept.entry(place).or_default();
        *entry = *entry + account;
    }
    audit.entries = kept.into_iter().map(|(place, account)| Entry { place, account }).collect();
    had_any
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::{
        tid::{AppAddress, Incarnation, NodeAddress},
        wire::Class,
    };

    use super::*;

    fn with_applications(count: u32) -> NodeAudit {
        let entry = |number: u32| Entry {
            place: Place::Mailbox {
                app: AppAddress::new(0x1000 + number),
                name: "n".repeat(63),
                class: Class::Control,
            },
            account: Account { taken: 1_000, delivered: 1_000, ..Account::default() },
        };
        NodeAudit {
            node: NodeAddress::new(1),
            name: "test".to_owned(),
            incarnation: Incarnation(1),
            entries: (0..count).map(entry).collect(),
            sessions: Vec::new(),
            refused: BTreeMap::new(),
        }
    }

    #[test]
    fn too_long_answer_merges_applications_without_loss() {
        let all = with_applications(500);
        for bytes_max in [usize::MAX, 8_000, 500] {
            let bytes = write(&all, bytes_max).expect("it has room");
            let report = read(&bytes).expect("it is an audit");
            assert_eq!(report.entries.iter().map(|entry| entry.account).sum::<Account>().taken, 500_000);
            assert!(bytes.len() <= bytes_max);
        }
        assert_eq!(write(&all, 10), None);
        assert_eq!(read(&write(&all, usize::MAX).unwrap()).unwrap(), all);
    }

    #[test]
    fn oversized_answer_is_not_decoded() {
        assert!(read(&vec![0x90; ANSWER_BYTES_MAX + 1].into()).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_an_audit_or_none(bytes: Vec<u8>, at: prop::sample::Index, new: u8) {
            let _ = read(&bytes.into());
            let mut damaged = write(&with_applications(3), usize::MAX).unwrap().to_vec();
            let at = at.index(damaged.len());
            damaged[at] = new;
            if let Ok(report) = read(&damaged.into()) {
                let before = std::slice::from_ref(&report);
                let audit = crate::audit::Audit::of(report.node, before, vec![report.clone()], Vec::new());
                let _ = audit.to_string();
            }
        }
    }
}
