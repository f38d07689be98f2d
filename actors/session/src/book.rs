//! The places of a node, and the accounts of those that have ended.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_runtime::{lock, mailbox::Mailbox, tid::AppAddress, wire::Class};

use crate::{
    counts::Account,
    direct_links::{self, CountsLinks, DirectCounts},
    outlet::{OutletAccount, Socket, SocketWriter, Taking},
    place::Place,
};

/// Maximum number of ended mailboxes that still have a message in handling. Beyond it the oldest is written
/// off.
const CLOSING_MAX: usize = 64;

/// One connection of another process. An id is never used again during the node's lifetime.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ClientId(pub u64);

/// A place that counts messages as an outlet does.
pub trait Accounted: Send + Sync {
    /// Returns where every message is that it has taken.
    fn account(&self) -> OutletAccount;

    /// Returns how far the peer has read the data sent to it; `None` if no peer is connected.
    fn taking(&self) -> Option<Taking>;
}

impl<S: Socket> Accounted for SocketWriter<S> {
    fn account(&self) -> OutletAccount {
        self.account().0
    }

    fn taking(&self) -> Option<Taking> {
        self.taking()
    }
}

/// A client to which messages are sent, and how far it has read them.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub struct ClientTaking {
    pub id: ClientId,
    pub app: AppAddress,
    /// Its name, or its address as text if it has none.
    pub name: Arc<str>,
    pub taking: Taking,
}

/// The places of a node. They outlive every layer.
#[derive(Default)]
pub struct Book(Mutex<Places>);

#[derive(Default)]
struct Places {
    mailboxes: BTreeMap<AppAddress, (Arc<str>, Arc<Mailbox>)>,
    /// Mailboxes that have ended while a message of theirs is in handling.
    closing: Vec<Arc<Mailbox>>,
    clients: BTreeMap<ClientId, Client>,
    former_mailboxes: Account,
    former_clients: Account,
    former_links: DirectCounts,
}

#[derive(Clone)]
struct Client {
    app: AppAddress,
    name: Arc<str>,
    outlet: Arc<dyn Accounted>,
    /// The counters of its direct links, if it can have any.
    links: Option<Arc<dyn CountsLinks>>,
}

impl Book {
    /// Adds the mailbox of the application at `app`.
    pub fn add_mailbox(&self, app: AppAddress, name: &str, mailbox: &Arc<Mailbox>) {
        lock(&self.0).mailboxes.insert(app, (name.into(), mailbox.clone()));
    }

    /// Removes the mailbox of the application at `app`, which has ended for good; its mailbox is closed.
    pub fn remove_mailbox(&self, app: AppAddress) {
        let mut places = lock(&self.0);
        if let Some((_, mailbox)) = places.mailboxes.remove(&app) {
            places.closing.push(mailbox);
            let surplus = places.closing.len().saturating_sub(CLOSING_MAX);
            places.write_off(surplus);
        }
    }

    /// Adds the outlet of a client.
    pub fn add_client(&self, id: ClientId, app: AppAddress, name: &str, outlet: Arc<dyn Accounted>) {
        lock(&self.0).clients.insert(id, Client { app, name: name.into(), outlet, links: None });
    }

    /// Adds the counters of a client's direct links.
    pub fn add_links(&self, id: ClientId, links: Arc<dyn CountsLinks>) {
        if let Some(client) = lock(&self.0).clients.get_mut(&id) {
            client.links = Some(links);
        }
    }

    /// Removes a disconnected client after the end of its outlet.
    pub fn remove_client(&self, id: ClientId) {
        let mut places = lock(&self.0);
        if let Some(Client { outlet, links, .. }) = places.clients.remove(&id) {
            places.former_clients = places.former_clients + Account::from(&outlet.account()).over();
            if let Some(links) = links {
                places.former_links = places.former_links + links.read().sum();
            }
        }
    }

    /// Returns how far each client has read its messages. Each is read atomically under its outlet's own
    /// lock: a sender waits for it as long as for another sender's message.
    pub fn takings(&self) -> Vec<ClientTaking> {
        let clients = lock(&self.0).clients.clone();
        let links = direct_links::progress(&linked(clients.values()));
        let taking = |(id, client): (ClientId, Client)| {
            let Client { app, name, outlet, links: _ } = client;
            let taking = outlet.taking()?;
            let taking = links.get(&app).map_or(taking, |progress| progress.beside(taking));
            Some(ClientTaking { id, app, name, taking })
        };
        clients.into_iter().filter_map(taking).collect()
    }

    /// Returns the current accounts of all places.
    pub fn read(&self) -> Vec<(Place, Account)> {
        let (mailboxes, clients, former_links, mut read) = self.list();
        for (app, (name, mailbox)) in mailboxes {
            read.extend(Class::ALL.map(|class| {
                let place = Place::Mailbox { app, name: name.to_string(), class };
                (place, Account::of_mailbox(mailbox.account(class)))
            }));
        }
        read.extend(direct_links::accounts(&linked(&clients), former_links));
        for Client { app, name, outlet, links: _ } in clients {
            let place = Place::Client { app, name: name.to_string() };
            read.push((place, Account::from(&outlet.account())));
        }
        read
    }

    /// Returns the places, and the accounts of those that have ended. Each place is in exactly one of the
    /// lists, even if it ends before it is read. Places are added and removed under this lock, which is not
    /// held while all accounts are read.
    #[expect(clippy::type_complexity, reason = "the state of one moment, for the function above alone")]
    fn list(
        &self,
    ) -> (Vec<(AppAddress, (Arc<str>, Arc<Mailbox>))>, Vec<Client>, DirectCounts, Vec<(Place, Account)>) {
        let mut places = lock(&self.0);
        places.write_off(0);
        let closing: Account = places.closing.iter().map(|mailbox| whole(mailbox)).sum();
        let ended = vec![
            (Place::OtherMailboxes, places.former_mailboxes + closing),
            (Place::OtherClients, places.former_clients),
        ];
        let mailboxes = places.mailboxes.iter().map(|(app, mailbox)| (*app, mailbox.clone())).collect();
        (mailboxes, places.clients.values().cloned().collect(), places.former_links, ended)
    }
}

impl Places {
    /// Closes the accounts of mailboxes that have no message in handling any more, and of the `surplus`
    /// oldest in any case.
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

/// Reads the counters of those that can have direct links.
fn linked<'a>(clients: impl IntoIterator<Item = &'a Client>) -> Vec<direct_links::Reader> {
    let read = |client: &Client| {
        let reading = client.links.as_ref()?.read();
        Some(direct_links::Reader { app: client.app, name: client.name.clone(), reading })
    };
    clients.into_iter().filter_map(read).collect()
}

/// Returns the account of all classes of a mailbox.
fn whole(mailbox: &Mailbox) -> Account {
    Class::ALL.iter().map(|class| Account::of_mailbox(mailbox.account(*class))).sum()
}
