//! What guests may have waiting at the layers of their node: the rest of a layer's queue is there for the robot's own, whatever guests send.
//!
//! A message of a guest to a layer has a place from when it leaves the guest's connection until it is handled. Its receipt has the place: that
//! is settled wherever the message ends, at the latest when it is dropped. What a post keeps of an event for its reader's successor has no
//! receipt, and so no place; of these there is one. Messages of the robot's own have no place, and take no lock here.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::Refused,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Message, Payload},
};

use crate::{stores::lock, sync::LeaveBarrier};

/// Messages of all guests but leaves that wait for the sync manager, at most: few of the 4,096 from which on it takes none of anybody.
const AT_SYNC_MAX: usize = 48;
/// Questions of all guests that wait for the inspection, at most: a quarter of all that do.
const AT_INSPECTION_MAX: usize = 8;
/// Of these two shares one user has this part at most: none keeps all others out alone. Two of them leave nothing for a third.
const USERS: usize = 2;
/// Leaves of all guests that wait for the sync manager, at most, and those of one user. Nobody says a leave again, so nothing else is in its way, and
/// there is room for all that the applications of a user give up at once, if these are not hundreds.
const LEAVES_MAX: usize = 1_024;
const LEAVES_OF_USER: usize = LEAVES_MAX / 4;

/// What one user may have waiting for the sync manager but for leaves.
#[cfg(test)]
pub(crate) const OF_USER_AT_SYNC: usize = AT_SYNC_MAX / USERS;

/// The shares of a node's guests.
#[derive(Default)]
pub(crate) struct Shares {
    sync: Arc<Share>,
    leaves: Arc<Share>,
    inspection: Arc<Share>,
}

impl Shares {
    /// Lets a message through that an application of the guest `uid` sends from the node at `here`, if guests leave enough to others with it.
    ///
    /// # Errors
    /// The message, which is refused: `QueueFull` where the guest, or all guests, have their share. Also what layers take from nobody, where
    /// it would wait past the share: for a sync manager elsewhere (`ForgedSource`, as that would say), or for a layer of all nodes
    /// (`Unsupported`).
    pub(crate) fn admit(
        &self,
        here: NodeAddress,
        uid: u32,
        mut message: Message,
    ) -> Result<Message, Refused> {
        let Tid { node, app } = message.header.destination;
        if !app.is_layer() {
            return Ok(message);
        }
        if node == NodeAddress::ALL {
            return Err(Refused::new(message, Rejection::Unsupported));
        }
        let is_here = node == here || node == NodeAddress::HERE;
        let (share, of_all, of_user) = match app {
            AppAddress::SYNC if !is_here => return Err(Refused::new(message, Rejection::ForgedSource)),
            AppAddress::SYNC if message.header.kind == LeaveBarrier::KIND => {
                (&self.leaves, LEAVES_MAX, LEAVES_OF_USER)
            }
            AppAddress::SYNC => (&self.sync, AT_SYNC_MAX, AT_SYNC_MAX / USERS),
            AppAddress::INSPECT if is_here => {
                (&self.inspection, AT_INSPECTION_MAX, AT_INSPECTION_MAX / USERS)
            }
            _ => return Ok(message),
        };
        let Some(place) = share.take(uid, of_all, of_user) else {
            return Err(Refused::new(message, Rejection::QueueFull));
        };
        let wanted = message.receipt.take();
        let ticket = wanted.as_ref().map_or_else(|| message.ticket(), Receipt::ticket);
        let placed = Placed(Mutex::new(Some((place, wanted))));
        message.receipt = Some(Receipt::new(Arc::new(placed), ticket));
        Ok(message)
    }
}

/// What guests have in one queue.
#[derive(Default)]
struct Share(Mutex<Waiting>);

#[derive(Default)]
struct Waiting {
    of_all: usize,
    /// Of a user who has none nothing is kept.
    of_user: BTreeMap<u32, usize>,
}

impl Share {
    /// A place for a message of this user, if all guests have fewer than `of_all`, and he has fewer than `of_user`.
    fn take(self: &Arc<Self>, uid: u32, of_all: usize, of_user: usize) -> Option<Place> {
        let mut waiting = lock(&self.0);
        let has = waiting.of_user.get(&uid).copied().unwrap_or(0);
        if waiting.of_all >= of_all || has >= of_user {
            return None;
        }
        waiting.of_all += 1;
        waiting.of_user.insert(uid, has + 1);
        Some(Place { share: self.clone(), uid })
    }
}

/// One message's place; dropped, it is given back.
struct Place {
    share: Arc<Share>,
    uid: u32,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut waiting = lock(&self.share.0);
        waiting.of_all -= 1;
        let Some(of_user) = waiting.of_user.get_mut(&self.uid) else { return };
        *of_user -= 1;
        if *of_user == 0 {
            waiting.of_user.remove(&self.uid);
        }
    }
}

/// Hears what becomes of a message that has a place, and tells whoever wanted to know.
struct Placed(Mutex<Option<(Place, Option<Receipt>)>>);

impl ReceiptSink for Placed {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        let Some((place, wanted)) = lock(&self.0).take() else { return };
        // First: whoever hears of the outcome may send the next one at once.
        drop(place);
        if let Some(wanted) = wanted {
            wanted.settle(outcome);
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

    /// What this user sends to a layer of its node until it is refused.
    fn fill(shares: &Shares, uid: u32, app: AppAddress) -> Vec<Message> {
        let send = || shares.admit(HERE, uid, message(HERE, app)).ok();
        std::iter::from_fn(send).take(10_000).collect()
    }

    fn why(shares: &Shares, message: Message) -> Rejection {
        shares.admit(HERE, USER, message).expect_err("it is refused").why
    }

    #[test]
    fn one_user_has_half_of_a_share_and_two_of_them_leave_nothing_for_a_third() {
        let at_sync = (AppAddress::SYNC, AT_SYNC_MAX);
        for (app, all) in [at_sync, (AppAddress::INSPECT, AT_INSPECTION_MAX)] {
            let shares = Shares::default();
            let held = [USER, USER + 1, USER + 2].map(|uid| fill(&shares, uid, app));
            assert_eq!(held.each_ref().map(Vec::len), [all / 2, all / 2, 0]);
            assert_eq!(why(&shares, message(NodeAddress::HERE, app)), Rejection::QueueFull);
            // And: the one who comes later has as much when the others have gone
            drop(held);
            assert_eq!(fill(&shares, USER + 2, app).len(), all / 2);
        }
    }

    #[test]
    fn a_place_is_given_back_once_whether_its_message_is_handled_refused_or_dropped() {
        let ends: [fn(Message); 3] = [
            |mut message| message.settle(Outcome::Delivered),
            |message| message.reject(Rejection::UnknownKind),
            drop::<Message>,
        ];
        let shares = Shares::default();
        for end in ends {
            let held = fill(&shares, USER, AppAddress::SYNC);
            assert_eq!(held.len(), OF_USER_AT_SYNC);
            held.into_iter().for_each(end);
            let waiting = lock(&shares.sync.0);
            assert!(waiting.of_all == 0 && waiting.of_user.is_empty(), "{} are left", waiting.of_all);
        }
    }

    /// Sends the next message as soon as it hears what became of one.
    struct Eager {
        shares: Arc<Shares>,
        heard: Mutex<Vec<(Outcome, bool)>>,
    }

    impl ReceiptSink for Eager {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            let next = self.shares.admit(HERE, USER, message(HERE, AppAddress::SYNC));
            lock(&self.heard).push((outcome, next.is_ok()));
        }
    }

    #[test]
    fn who_hears_what_became_of_its_message_hears_it_once_and_has_its_place_again_already() {
        // Given: a user that has all that it may, the first of them with a receipt
        let shares = Arc::new(Shares::default());
        let eager = Arc::new(Eager { shares: shares.clone(), heard: Mutex::default() });
        let mut first = message(HERE, AppAddress::SYNC);
        first.receipt = Some(Receipt::new(eager.clone(), first.ticket()));
        let Ok(mut first) = shares.admit(HERE, USER, first) else { panic!("nobody has anything yet") };
        let _others = fill(&shares, USER, AppAddress::SYNC);
        // When
        first.settle(Outcome::Expired);
        drop(first);
        // Then
        assert_eq!(*lock(&eager.heard), [(Outcome::Expired, true)]);
    }

    #[test]
    fn leaves_find_room_whatever_else_anybody_sends_and_have_a_bound_too() {
        // Given: guests that have all that they may, one of them leaves, too
        let shares = Shares::default();
        let leaves = |uid| {
            let next = || shares.admit(HERE, uid, leave()).ok();
            std::iter::from_fn(next).take(10_000).collect::<Vec<_>>()
        };
        let others = [USER, USER + 1].map(|uid| fill(&shares, uid, AppAddress::SYNC));
        // When, then
        let held = [0, 1, 2, 3, 4].map(|number| leaves(USER + number));
        assert_eq!(held.each_ref().map(Vec::len), [256, 256, 256, 256, 0]);
        // And: leaves are in the way of nothing else
        drop(others);
        assert_eq!(fill(&shares, USER, AppAddress::SYNC).len(), OF_USER_AT_SYNC);
    }

    #[test]
    fn nothing_of_a_guest_comes_to_layers_past_its_share_and_applications_are_no_concern_of_it() {
        let shares = Shares::default();
        let elsewhere = message(THERE, AppAddress::SYNC);
        assert_eq!(why(&shares, elsewhere), Rejection::ForgedSource);
        for app in [AppAddress::SYNC, AppAddress::INSPECT] {
            assert_eq!(why(&shares, message(NodeAddress::ALL, app)), Rejection::Unsupported);
        }
        let _full = fill(&shares, USER, AppAddress::SYNC);
        let knee = AppAddress::new(0x1001);
        for (node, app) in [(HERE, knee), (NodeAddress::ALL, AppAddress::ALL), (THERE, AppAddress::INSPECT)] {
            let admitted = shares.admit(HERE, USER, message(node, app));
            assert!(admitted.is_ok_and(|message| message.receipt.is_none()), "{node}/{app}");
        }
    }
}
