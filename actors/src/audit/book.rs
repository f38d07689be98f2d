//! Which places of a node there are, and the accounts of those that are gone.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_runtime::{mailbox::Mailbox, tid::AppAddress, wire::Class};

use super::account::{Account, Place};
use crate::{
    lncl::ClientId,
    outlet::{OutletAccount, Socket, StreamOutlet, Taking},
    stores::lock,
};

/// Mailboxes at most that are gone and still have a message out. Of a further one the first is written off.
const CLOSING_MAX: usize = 64;

/// Something that counts as an outlet does.
pub(crate) trait Accounted: Send + Sync {
    /// Where every message is that it has taken.
    fn account(&self) -> OutletAccount;

    /// How far the one behind it has come with what it was sent; `None` if nobody is there yet, or any more.
    fn taking(&self) -> Option<Taking>;
}

impl<S: Socket> Accounted for StreamOutlet<S> {
    fn account(&self) -> OutletAccount {
        self.account().0
    }

    fn taking(&self) -> Option<Taking> {
        self.taking()
    }
}

/// A client to which messages flow, and how far it has come with them.
#[derive(Clone, Debug)]
pub(crate) struct ClientTaking {
    pub(crate) id: ClientId,
    pub(crate) app: AppAddress,
    /// Its address in words, if it has no name.
    pub(crate) name: Arc<str>,
    pub(crate) taking: Taking,
}

/// The places of a node. It outlives every layer.
#[derive(Default)]
pub(crate) struct Book(Mutex<Places>);

#[derive(Default)]
struct Places {
    mailboxes: BTreeMap<AppAddress, (Arc<str>, Arc<Mailbox>)>,
    /// Mailboxes that are gone, of which a message is in hand.
    closing: Vec<Arc<Mailbox>>,
    clients: BTreeMap<ClientId, Client>,
    former_mailboxes: Account,
    former_clients: Account,
}

#[derive(Clone)]
struct Client {
    app: AppAddress,
    name: Arc<str>,
    outlet: Arc<dyn Accounted>,
}

impl Book {
    /// The mailbox of the application at `app`.
    pub(crate) fn add_mailbox(&self, app: AppAddress, name: &str, mailbox: &Arc<Mailbox>) {
        lock(&self.0).mailboxes.insert(app, (name.into(), mailbox.clone()));
    }

    /// The application at `app` is gone for good, and its mailbox closed.
    pub(crate) fn remove_mailbox(&self, app: AppAddress) {
        let mut places = lock(&self.0);
        if let Some((_, mailbox)) = places.mailboxes.remove(&app) {
            places.closing.push(mailbox);
            let surplus = places.closing.len().saturating_sub(CLOSING_MAX);
            places.write_off(surplus);
        }
    }

    /// What waits for a client.
    pub(crate) fn add_client(&self, id: ClientId, app: AppAddress, name: &str, outlet: Arc<dyn Accounted>) {
        lock(&self.0).clients.insert(id, Client { app, name: name.into(), outlet });
    }

    /// The client is gone, and its outlet has ended.
    pub(crate) fn remove_client(&self, id: ClientId) {
        let mut places = lock(&self.0);
        if let Some(Client { outlet, .. }) = places.clients.remove(&id) {
            places.former_clients = places.former_clients + Account::of_outlet(&outlet.account()).over();
        }
    }

    /// How far each client has come, as many as there are. Each is read at one moment, under its outlet's own lock: who sends to it
    /// meanwhile waits as long as for another sender's message.
    pub(crate) fn takings(&self) -> Vec<ClientTaking> {
        let clients = lock(&self.0).clients.clone();
        let taking = |(id, client): (ClientId, Client)| {
            let Client { app, name, outlet } = client;
            Some(ClientTaking { id, app, name, taking: outlet.taking()? })
        };
        clients.into_iter().filter_map(taking).collect()
    }

    /// The accounts of all places, now.
    pub(super) fn read(&self) -> Vec<(Place, Account)> {
        let (mailboxes, clients, mut read) = self.list();
        for (app, (name, mailbox)) in mailboxes {
            read.extend(Class::ALL.map(|class| {
                let place = Place::Mailbox { app, name: name.to_string(), class };
                (place, Account::of_mailbox(mailbox.account(class)))
            }));
        }
        for Client { app, name, outlet } in clients {
            let place = Place::Client { app, name: name.to_string() };
            read.push((place, Account::of_outlet(&outlet.account())));
        }
        read
    }

    /// Which places there are, and the accounts of those that are gone: each is in one of them, also where it goes before it is read. Whoever
    /// comes or goes waits for this, and not for the reading of all accounts.
    #[expect(clippy::type_complexity, reason = "three lists of one moment, for the function above alone")]
    fn list(&self) -> (Vec<(AppAddress, (Arc<str>, Arc<Mailbox>))>, Vec<Client>, Vec<(Place, Account)>) {
        let mut places = lock(&self.0);
        places.write_off(0);
        let closing: Account = places.closing.iter().map(|mailbox| whole(mailbox)).sum();
        let gone = vec![
            (Place::OtherMailboxes, places.former_mailboxes + closing),
            (Place::OtherClients, places.former_clients),
        ];
        let mailboxes = places.mailboxes.iter().map(|(app, mailbox)| (*app, mailbox.clone())).collect();
        (mailboxes, places.clients.values().cloned().collect(), gone)
    }
}

impl Places {
    /// Closes the accounts of mailboxes that have nothing out any more, and of the `surplus` oldest in any case.
    fn write_off(&mut self, surplus: usize) {
        let mut at = 0;
        let former = &mut self.former_mailboxes;
        self.closing.retain(|mailbox| {
            let account = whole(mailbox);
            let is_over = at < surplus || account.waiting == 0;
            at += 1;
            if is_over {
                *former = *former + account.over();
            }
            !is_over
        });
    }
}

/// All classes of a mailbox.
fn whole(mailbox: &Mailbox) -> Account {
    Class::ALL.iter().map(|class| Account::of_mailbox(mailbox.account(*class))).sum()
}
