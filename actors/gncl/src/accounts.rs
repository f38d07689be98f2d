//! The accounts of messages to and from other nodes.

use sinew_runtime::wire::Class;
use sinew_session::{counts::Account, place::Place};

use super::{Peer, SessionAccount, State};

impl State {
    /// Returns the accounts of all peers, by place. A place may occur several times: its accounts are added.
    pub fn accounts(&self) -> Vec<(Place, Account)> {
        let mut accounts = Vec::new();
        // Held until the accounts of ended peers are read, so that none is in both.
        let all = self.store.all_incarnations();
        for peer in &all {
            for (class, session) in session_accounts(peer) {
                let node = peer.node;
                accounts.push((Place::ToNode { node, class }, Account::from(&session.sent)));
                accounts.push((Place::FromNode { node, class }, Account::from(&session.arrived)));
            }
        }
        let ended = self.store.ended_accounts();
        accounts.push((Place::ToFormerNodes, ended.sent));
        accounts.push((Place::FromFormerNodes, ended.arrived));
        accounts
    }

    /// Returns the account of one place.
    #[cfg(test)]
    pub(super) fn account(&self, at: &Place) -> Account {
        self.accounts().into_iter().filter(|(place, _)| place == at).map(|(_, account)| account).sum()
    }
}

/// Returns the accounts of the sessions with a peer, and the class of each.
pub fn session_accounts(peer: &Peer) -> impl Iterator<Item = (Option<Class>, SessionAccount)> {
    let accounts = peer.accounts();
    let by_class = accounts.len() > 1;
    let class = move |at: usize| Class::ALL.get(at).copied().filter(|_| by_class);
    accounts.into_iter().enumerate().map(move |(at, session)| (class(at), session))
}
