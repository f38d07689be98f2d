//! Quotas of guests in the queues of their node's layers. The rest of each queue is reserved for the node's own
//! applications.
//!
//! A message of a guest to a layer holds a slot from its guest's connection until it is handled. Its receipt holds the
//! slot, and is settled wherever the message ends, at the latest when it is dropped. The one event that a queue keeps
//! for its reader's successor has no receipt, and so no slot. Messages of the node's own applications have no slot, and
//! take no lock here.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_runtime::{
    lock,
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::SubmitError,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Kind, Message, Payload},
};

use crate::barrier::LeaveBarrier;

/// Maximum number of messages of all guests, except leaves, that wait for the sync manager. Its queue rejects all
/// messages from 4,096 on.
const AT_SYNC_MAX: usize = 48;
/// Maximum number of requests of all guests that wait for the inspection: a quarter of its queue.
const AT_INSPECTION_MAX: usize = 8;
/// One user may use one part in this many of these two quotas, so no user alone can lock out all others. Two users
/// leave nothing for a third.
const USERS: usize = 2;
/// Maximum number of leaves that wait for the sync manager, of all guests and of one user. A leave is never repeated,
/// so it has a quota of its own. The quota has room for all leaves of a user's ending applications, unless these are
/// hundreds.
const LEAVES_MAX: usize = 1_024;
const LEAVES_OF_USER: usize = LEAVES_MAX / 4;

/// Questions that a node sends to the inspection of another node for its own user's applications only: payloads of
/// recordings are in the answers.
pub const OF_OWN_USERS: [Kind; 2] =
    [Kind::named("sinew.inspect.frozen"), Kind::named("sinew.inspect.freeze")];

/// Maximum number of one user's messages, except leaves, that wait for the sync manager.
pub const OF_USER_AT_SYNC: usize = AT_SYNC_MAX / USERS;

/// The quotas of a node's guests.
#[derive(Default)]
pub struct GuestQuotas {
    sync: Arc<Quota>,
    leaves: Arc<Quota>,
    inspection: Arc<Quota>,
}

impl GuestQuotas {
    /// Admits a message that an application of the guest `uid` sends from the node at `here`, if the guests' quota has
    /// room.
    ///
    /// # Errors
    /// The rejected message: `QueueFull` if the quota of the guest, or of all guests, is used up. Messages that layers
    /// accept from no one are rejected, too, since they would bypass the quota. These are messages to a remote sync
    /// manager (`ForgedSource`, as that one would report), and to a layer of all nodes (`Unsupported`). Guests neither
    /// press nor read the stop (`NotAllowed`).
    pub fn admit(&self, here: NodeAddress, uid: u32, mut message: Message) -> Result<Message, SubmitError> {
        let Tid { node, app } = message.header.destination;
        if !app.is_layer() {
            return Ok(message);
        }
        if node == NodeAddress::ALL {
            return Err(SubmitError::new(message, Rejection::Unsupported));
        }
        let is_here = node == here || node == NodeAddress::HERE;
        let (quota, of_all, of_user) = match app {
            AppAddress::SYNC if !is_here => return Err(SubmitError::new(message, Rejection::ForgedSource)),
            AppAddress::SYNC if message.header.kind == LeaveBarrier::KIND => {
                (&self.leaves, LEAVES_MAX, LEAVES_OF_USER)
            }
            AppAddress::SYNC => (&self.sync, AT_SYNC_MAX, OF_USER_AT_SYNC),
            // The other node does not know the user: this one does.
            AppAddress::INSPECT if !is_here && OF_OWN_USERS.contains(&message.header.kind) => {
                return Err(SubmitError::new(message, Rejection::Unsupported));
            }
            // Guests have no part in the robot's stop, on any node.
            AppAddress::STOP => return Err(SubmitError::new(message, Rejection::NotAllowed)),
            AppAddress::INSPECT if is_here => {
                (&self.inspection, AT_INSPECTION_MAX, AT_INSPECTION_MAX / USERS)
            }
            _ => return Ok(message),
        };
        let Some(slot) = quota.take(uid, of_all, of_user) else {
            return Err(SubmitError::new(message, Rejection::QueueFull));
        };
        let original = message.receipt.take();
        let ticket = original.as_ref().map_or_else(|| message.ticket(), Receipt::ticket);
        let receipt = SlotReceipt(Mutex::new(Some((slot, original))));
        message.receipt = Some(Receipt::new(Arc::new(receipt), ticket));
        Ok(message)
    }
}

/// The used slots of one quota.
#[derive(Default)]
struct Quota(Mutex<UsedSlots>);

#[derive(Default)]
struct UsedSlots {
    of_all: usize,
    /// A user without slots has no entry.
    of_user: BTreeMap<u32, usize>,
}

impl Quota {
    /// Takes a slot for a message of this user, if all guests hold fewer than `of_all`, and the user fewer than
    /// `of_user`.
    fn take(self: &Arc<Self>, uid: u32, of_all: usize, of_user: usize) -> Option<Slot> {
        let mut used = lock(&self.0);
        let has = used.of_user.get(&uid).copied().unwrap_or(0);
        if used.of_all >= of_all || has >= of_user {
            return None;
        }
        used.of_all += 1;
        used.of_user.insert(uid, has + 1);
        Some(Slot { quota: self.clone(), uid })
    }
}

/// The slot of one message. Dropping it releases it.
struct Slot {
    quota: Arc<Quota>,
    uid: u32,
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut used = lock(&self.quota.0);
        used.of_all -= 1;
        let Some(of_user) = used.of_user.get_mut(&self.uid) else { return };
        *of_user -= 1;
        if *of_user == 0 {
            used.of_user.remove(&self.uid);
        }
    }
}

/// Receives the outcome of a message with a slot, and forwards it to the original receipt.
struct SlotReceipt(Mutex<Option<(Slot, Option<Receipt>)>>);

impl ReceiptSink for SlotReceipt {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        let Some((slot, original)) = lock(&self.0).take() else { return };
        // Released first: a receiver of the outcome may send its next message at once.
        drop(slot);
        if let Some(original) = original {
            original.settle(outcome);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sinew_runtime::wire::{Header, Kind};

    use super::*;

    const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const THERE: NodeAddress = NodeAddress::new(0x7f00_0002);
    const GUEST: Tid = Tid::new(HERE, AppAddress::new(0x8000_0001));
    const USER: u32 = 1_001;

    fn message(node: NodeAddress, app: AppAddress) -> Message {
        Message::new(Header::new(Kind::named("test.any"), GUEST, Tid::new(node, app)), Bytes::new())
    }

    fn leave() -> Message {
        let leave = LeaveBarrier { barrier: "calibrated".to_owned(), correlation: None };
        Message::typed(GUEST, Tid::new(HERE, AppAddress::SYNC), &leave)
    }

    /// Sends messages of this user to a layer of its node until one is refused. Returns the accepted ones.
    fn fill(quotas: &GuestQuotas, uid: u32, app: AppAddress) -> Vec<Message> {
        let send = || quotas.admit(HERE, uid, message(HERE, app)).ok();
        std::iter::from_fn(send).take(10_000).collect()
    }

    fn why(quotas: &GuestQuotas, message: Message) -> Rejection {
        quotas.admit(HERE, USER, message).expect_err("it is refused").why
    }

    #[test]
    fn two_users_fill_a_share() {
        let at_sync = (AppAddress::SYNC, AT_SYNC_MAX);
        for (app, all) in [at_sync, (AppAddress::INSPECT, AT_INSPECTION_MAX)] {
            let quotas = GuestQuotas::default();
            let held = [USER, USER + 1, USER + 2].map(|uid| fill(&quotas, uid, app));
            assert_eq!(held.each_ref().map(Vec::len), [all / 2, all / 2, 0]);
            assert_eq!(why(&quotas, message(NodeAddress::HERE, app)), Rejection::QueueFull);
            // And: after the others have gone, the third user has as much
            drop(held);
            assert_eq!(fill(&quotas, USER + 2, app).len(), all / 2);
        }
    }

    #[test]
    fn any_end_of_a_message_releases_its_slot_once() {
        let ends: [fn(Message); 3] = [
            |mut message| message.settle(Outcome::Delivered),
            |message| message.reject(Rejection::UnknownKind),
            drop::<Message>,
        ];
        let quotas = GuestQuotas::default();
        for end in ends {
            let held = fill(&quotas, USER, AppAddress::SYNC);
            assert_eq!(held.len(), OF_USER_AT_SYNC);
            held.into_iter().for_each(end);
            let used = lock(&quotas.sync.0);
            assert!(used.of_all == 0 && used.of_user.is_empty(), "{} are left", used.of_all);
        }
    }

    /// Sends the next message as soon as it receives the outcome of one.
    struct Eager {
        quotas: Arc<GuestQuotas>,
        outcomes: Mutex<Vec<(Outcome, bool)>>,
    }

    impl ReceiptSink for Eager {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            let next = self.quotas.admit(HERE, USER, message(HERE, AppAddress::SYNC));
            lock(&self.outcomes).push((outcome, next.is_ok()));
        }
    }

    #[test]
    fn outcome_arrives_once_after_the_slot_is_released() {
        // Given: a user with its full quota, the first message with a receipt
        let quotas = Arc::new(GuestQuotas::default());
        let eager = Arc::new(Eager { quotas: quotas.clone(), outcomes: Mutex::default() });
        let mut first = message(HERE, AppAddress::SYNC);
        first.receipt = Some(Receipt::new(eager.clone(), first.ticket()));
        let Ok(mut first) = quotas.admit(HERE, USER, first) else { panic!("nobody has anything yet") };
        let _others = fill(&quotas, USER, AppAddress::SYNC);
        // When
        first.settle(Outcome::Expired);
        drop(first);
        // Then
        assert_eq!(*lock(&eager.outcomes), [(Outcome::Expired, true)]);
    }

    #[test]
    fn leaves_have_their_own_bounded_room() {
        // Given: guests with their full quotas, one of which leaves, too
        let quotas = GuestQuotas::default();
        let leaves = |uid| {
            let next = || quotas.admit(HERE, uid, leave()).ok();
            std::iter::from_fn(next).take(10_000).collect::<Vec<_>>()
        };
        let others = [USER, USER + 1].map(|uid| fill(&quotas, uid, AppAddress::SYNC));
        // When, then
        let held = [0, 1, 2, 3, 4].map(|number| leaves(USER + number));
        assert_eq!(held.each_ref().map(Vec::len), [256, 256, 256, 256, 0]);
        // And: leaves take no room of other messages
        drop(others);
        assert_eq!(fill(&quotas, USER, AppAddress::SYNC).len(), OF_USER_AT_SYNC);
    }

    #[test]
    fn guests_are_limited_to_their_share_at_layers_only() {
        let quotas = GuestQuotas::default();
        let elsewhere = message(THERE, AppAddress::SYNC);
        assert_eq!(why(&quotas, elsewhere), Rejection::ForgedSource);
        for app in [AppAddress::SYNC, AppAddress::INSPECT] {
            assert_eq!(why(&quotas, message(NodeAddress::ALL, app)), Rejection::Unsupported);
        }
        for node in [HERE, THERE] {
            assert_eq!(why(&quotas, message(node, AppAddress::STOP)), Rejection::NotAllowed);
        }
        for kind in OF_OWN_USERS {
            let mut frozen = message(THERE, AppAddress::INSPECT);
            frozen.header.kind = kind;
            assert_eq!(why(&quotas, frozen), Rejection::Unsupported);
        }
        let _full = fill(&quotas, USER, AppAddress::SYNC);
        let knee = AppAddress::new(0x1001);
        for (node, app) in [(HERE, knee), (NodeAddress::ALL, AppAddress::ALL), (THERE, AppAddress::INSPECT)] {
            let admitted = quotas.admit(HERE, USER, message(node, app));
            assert!(admitted.is_ok_and(|message| message.receipt.is_none()), "{node}/{app}");
        }
    }
}
