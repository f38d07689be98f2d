//! The membership core: datagrams, link facts and time in; orders to the shell and facts for others out.
//!
//! After each input the shell takes [`Core::poll`] until it is empty, then sleeps until [`Core::next_wake`]. The core
//! outlives the shell: it stands in the node's stores, and a restarted shell goes on with the same members.
//!
//! | file | what it decides |
//! | --- | --- |
//! | `budget` | what a flood may cost |
//! | `contact` | an address that is talked to |
//! | `contacts` | all of them, and how many are candidates |
//! | `sources` | who says where to ask |
//! | `cycle` | who is asked when, and who missed too much |
//! | `heard` | what a datagram means, and what it proves |
//! | `member` | what is known of a node that answers |
//! | `own` | which addresses lead to this host |
//! | `lives` | who comes, goes, comes again |
//! | `contest` | a newcomer with a member's address: a restart, or a second process |
//! | `gone` | who has gone, and where he is asked |
//! | `duplicates` | which of two processes has a node address |
//! | `proven` | whom no datagram ends, where nodes have keys |
//! | `routes` | from where to where a member is asked |
//! | `pace` | how often which members are asked |
//! | `host` | what the host of a silent member says |
//! | `signs` | what GNCL heard of a member that does not answer |
//! | `troubles` | what of a member does not get on |
//! | `audience` | who is told, and what of it has not been taken |
//! | `clock` | how far a peer's clock is from ours |
//! | `memory` | where members are asked first after a restart |
//! | `recall` | what is told to whoever asks, and decides nothing |

mod audience;
mod budget;
mod clock;
mod contact;
mod contacts;
mod contest;
mod cycle;
mod duplicates;
mod gone;
mod heard;
mod host;
mod lives;
mod member;
mod memory;
mod own;
mod pace;
mod proven;
mod recall;
mod routes;
mod signs;
#[cfg(test)]
mod simulation;
mod sources;
#[cfg(test)]
mod tests;
mod troubles;
mod view;

use std::{
    collections::{BTreeMap, VecDeque},
    hash::{DefaultHasher, Hash, Hasher},
    net::{SocketAddr, SocketAddrV4},
    time::Duration,
};

use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

pub(crate) use self::host::Host;
pub(crate) use self::memory::{REMEMBERED_MAX, RememberedPeer, UNANSWERED_MAX};
pub use self::recall::OwnStalls;
pub(crate) use self::recall::{LostNode, Neighbour};
pub(crate) use self::routes::Place;
pub use self::sources::Source;
pub(crate) use self::sources::SourceCounts;
pub use self::view::{IdleApp, KnownNode, KnownRoute, TroubledApp};
use self::{
    audience::Audience,
    budget::Strangers,
    contact::{Question, Questions, Role},
    contacts::Contacts,
    contest::Contest,
    duplicates::{Claimant, Trial},
    gone::Gone,
    member::Member,
    memory::Memory,
    own::Own,
    pace::{Pace, REST},
    proven::Proven,
    recall::Recall,
};
use super::{
    MembershipFact, NodeEvent, Progress,
    datagram::{Announcement, Answer, Claim, FURTHER_MAX, Leave},
};
use crate::{clocks::ClockOffset, config::NodeConfig, gncl::LinkFact, lncl::AppFact, refusals::Refusals};

/// What happened.
#[derive(Clone, Debug)]
pub(crate) enum Input {
    /// Somebody asked.
    QueryReceived(Query),
    /// Somebody answered; `sent` is in its clock.
    AnswerReceived { from: Place, correlation: u64, sent: Time, answer: Answer },
    /// Somebody said goodbye.
    LeaveReceived { from: Place, leave: Leave },
    /// A source outside of the core says that a node of this project is at this address.
    AddressNamed { source: Source, address: SocketAddr },
    /// Where members of earlier lives of this node answered, as far as that was kept; said once, also if there are none.
    PeersRemembered(Vec<RememberedPeer>),
    /// A connection of GNCL changed.
    Link(LinkFact),
    /// The host of a node that missed answers was tried, as [`Output::Probe`] asked.
    Probed { node: NodeAddress, incarnation: Incarnation, host: Host, asked: Time },
    /// GNCL read something of this life of a node at that time; of those [in doubt](Core::in_doubt).
    SignSeen { node: NodeAddress, incarnation: Incarnation, at: Time },
    /// It is time for [`Core::next_wake`].
    TimePassed,
    /// The node stops in order.
    Stopping,
    /// An application that handles [`NodeEvent`] became ready, failed, went.
    AppChanged(AppFact),
    /// The node's root says what of this node does not get on.
    ProgressSeen(Progress),
    /// An application had no room for the last [`Output::Event`], which was for it.
    EventNotTaken { app: AppAddress },
}

/// What is to be done, or has become known.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    SendQuery {
        to: Place,
        correlation: u64,
    },
    /// From each of these addresses of ours.
    SendMulticastQuery {
        from: Vec<SocketAddr>,
        correlation: u64,
    },
    SendAnswer {
        to: Place,
        node: NodeAddress,
        correlation: u64,
        query_sent: Time,
        query_received: Time,
    },
    SendLeave {
        to: Place,
        node: NodeAddress,
    },
    /// Try to connect to the host of this node, at these addresses of its GNCL, and tell what it [said](Host::by) within this time. Have its
    /// GNCL give a sign on the connections that stand.
    Probe {
        node: NodeAddress,
        incarnation: Incarnation,
        to: Vec<SocketAddr>,
        within: Duration,
        asked: Time,
    },
    /// Have the GNCL of this life of a node give a sign on the connections that stand.
    AskForSign {
        node: NodeAddress,
        incarnation: Incarnation,
    },
    /// For GNCL and the sync manager.
    Fact(MembershipFact),
    /// For GNCL: a member listens elsewhere now, the address that it prefers first.
    Moved {
        node: NodeAddress,
        incarnation: Incarnation,
        gncl: Vec<SocketAddr>,
    },
    /// For GNCL: an earlier life than this one is about to be found, and nothing bars it any more.
    Forgotten {
        node: NodeAddress,
        incarnation: Incarnation,
    },
    /// For this application.
    Event {
        to: AppAddress,
        event: NodeEvent,
    },
    /// The clock of this life of a node is so far from ours.
    ClockMeasured {
        node: NodeAddress,
        incarnation: Incarnation,
        offset: ClockOffset,
    },
    /// Two living processes have one node address; the newcomer is no member, or not any more.
    Collision {
        node: NodeAddress,
        holder: Claimant,
        newcomer: Claimant,
    },
    /// This node's own address is another's already: it must not go on.
    AddressTaken {
        holder: Claimant,
    },
    /// Our own timer was this late: nobody was counted as silent, unless it has been late for long.
    Stalled {
        late: Duration,
    },
}

/// A query that somebody sent; `sent` is in its clock.
#[derive(Clone, Debug)]
pub(crate) struct Query {
    pub(crate) from: Place,
    pub(crate) way: Way,
    pub(crate) correlation: u64,
    pub(crate) sent: Time,
    pub(crate) announcement: Announcement,
}

/// Which way a datagram came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// To this node's own address.
    Unicast,
    /// To the multicast group.
    Multicast,
}

/// Counts as an instance of the shell: an older one that still runs is not listened to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Epoch(u64);

/// Who is there.
#[derive(Debug)]
pub(crate) struct Core {
    /// What this node says about itself.
    me: Announcement,
    /// The first is that of who is in no group.
    paces: Vec<Pace>,
    /// What of this node does not get on.
    progress: Progress,
    nodes_max: usize,
    seeds: Vec<SocketAddr>,
    asks_group: bool,
    /// Makes correlation ids that nobody guesses who has not seen them.
    secret: u128,
    questions_asked: u64,

    epoch: u64,
    /// Our own UDP addresses, one for each path; none before the first start.
    paths: Vec<SocketAddr>,
    own: Own,
    /// One of them has gone since another one came: who left while we were there knows us at that one.
    has_moved: bool,
    /// Until then, a living node with our address means that we are the newcomer.
    settles: Option<Time>,
    /// To then at most that is put off, while another one with our address settles, too.
    settles_at_latest: Time,
    /// Since when it settles that had settled before: others may have heard that last.
    settles_anew: Option<Time>,
    /// It had members and has none any more: others may have given its address to a later life.
    is_lonely: bool,
    /// Another process is about to be believed that our address is its own.
    trial: Option<Trial>,
    stall_reported: Option<Time>,

    members: BTreeMap<NodeAddress, Member>,
    gone: BTreeMap<NodeAddress, Gone>,
    proven: Proven,
    contests: BTreeMap<NodeAddress, Contest>,
    contacts: Contacts,
    group_questions: Questions,
    strangers: Strangers,
    collisions_reported: BTreeMap<NodeAddress, Time>,

    /// Applications that hear of changes.
    audience: Audience,
    outputs: VecDeque<Output>,
    refusals: Refusals,
    memory: Memory,
    recall: Recall,
}

impl Core {
    /// The core of the node at `node` that knows nobody yet. `boot_nonce` and `secret` are random; the second is told
    /// to nobody.
    pub(crate) fn new(
        config: &NodeConfig,
        node: NodeAddress,
        incarnation: Incarnation,
        boot_nonce: u64,
        secret: u128,
    ) -> Self {
        let ndl = &config.ndl;
        let me = Announcement {
            project: config.project.clone(),
            node,
            name: config.name.clone(),
            incarnation,
            boot_nonce,
            gncl_ip: 0,
            gncl_port: 0,
            period_us: u32::try_from(ndl.period.as_micros()).unwrap_or(u32::MAX),
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            ndl6: Vec::new(),
            gncl_port6: 0,
            claim: Claim::Settling,
        };
        Self {
            me,
            paces: Pace::all_of(ndl),
            progress: Progress::default(),
            nodes_max: ndl.nodes_max,
            seeds: ndl.seeds.iter().map(|seed| seed.address).collect(),
            asks_group: ndl.multicast.is_some(),
            secret,
            questions_asked: 0,
            epoch: 0,
            paths: Vec::new(),
            own: Own::default(),
            has_moved: false,
            settles: None,
            settles_at_latest: Time::ZERO,
            settles_anew: None,
            is_lonely: false,
            trial: None,
            stall_reported: None,
            members: BTreeMap::new(),
            gone: BTreeMap::new(),
            proven: Proven::new(config),
            contests: BTreeMap::new(),
            contacts: Contacts::default(),
            group_questions: Questions::default(),
            strangers: Strangers::new(Time::ZERO),
            collisions_reported: BTreeMap::new(),
            audience: Audience::new(ndl.nodes_max),
            outputs: VecDeque::new(),
            refusals: Refusals::default(),
            memory: Memory::default(),
            recall: Recall::default(),
        }
    }

    /// GNCL listens at these addresses, the one that it prefers first; at none for now, if there is none. And at this port where this node has
    /// IPv6 addresses.
    pub(crate) fn announce_gncl(&mut self, (addresses, port6): (Vec<SocketAddrV4>, Option<u16>)) {
        let mut all = addresses.into_iter().map(|gncl| (gncl.ip().to_bits(), gncl.port()));
        (self.me.gncl_ip, self.me.gncl_port) = all.next().unwrap_or_default();
        self.me.gncl_further = all.take(FURTHER_MAX).collect();
        self.me.gncl_port6 = port6.unwrap_or(0);
    }

    /// A shell has bound its sockets: `paths` are our addresses for queries. The first queries are due at once.
    pub(crate) fn start(&mut self, now: Time, paths: &[SocketAddr]) -> Epoch {
        self.epoch += 1;
        self.use_paths(now, paths);
        self.begin(now);
        Epoch(self.epoch)
    }

    /// Whether `epoch` is that of the newest shell.
    pub(crate) const fn is_current(&self, epoch: Epoch) -> bool {
        self.epoch == epoch.0
    }

    /// Takes in what happened.
    pub(crate) fn handle(&mut self, now: Time, input: Input) {
        self.offer_again(now);
        if let Input::EventNotTaken { app } = input {
            self.audience.not_taken(now, app);
            return;
        }
        if let Input::AppChanged(fact) = input {
            self.app_changed(&fact);
            return;
        }
        if let Input::ProgressSeen(progress) = input {
            self.progress = progress;
            return;
        }
        let Some(due) = self.rest().due else { return };
        if now.since(due) > self.loss_bound() {
            // We got no processor for so long that others may have lost us, and have found a later life.
            self.settle(now);
        }
        match input {
            Input::QueryReceived(query) => {
                if self.concerns_us(now, query.from, &query.announcement) {
                    self.queried(now, &query);
                }
            }
            Input::AnswerReceived { from, correlation, sent, answer } => {
                if self.concerns_us(now, from, &answer.announcement) {
                    self.answered(now, from, (correlation, sent), answer);
                }
            }
            Input::LeaveReceived { from, leave } => {
                if self.concerns_us(now, from, &leave.announcement) {
                    self.taken_leave_of(now, from, leave);
                }
            }
            Input::AddressNamed { source, address } => self.named(now, source, address),
            Input::PeersRemembered(peers) => self.recalled(now, peers),
            Input::Link(fact) => self.linked(now, fact),
            Input::Probed { node, incarnation, host, asked } => self.probed(node, incarnation, host, asked),
            Input::SignSeen { node, incarnation, at } => self.sign_seen(now, node, incarnation, at),
            Input::TimePassed => self.time_passed(now),
            Input::Stopping => self.leave(),
            Input::AppChanged(_) | Input::ProgressSeen(_) | Input::EventNotTaken { .. } => {
                unreachable!("it was taken above, whether NDL runs or not")
            }
        }
    }

    /// An application hears of changes from when it is ready, and first of all who is there. // spec: NDL-8
    fn app_changed(&mut self, fact: &AppFact) {
        match *fact {
            AppFact::Ready { app } => {
                self.audience.add(app);
                for member in self.members.values() {
                    let Announcement { node, incarnation, ref name, .. } = member.announcement;
                    let event = NodeEvent::NodeFound { node, incarnation, name: name.clone() };
                    self.audience.tell(app, event);
                    for part in member.troubles.parts() {
                        self.audience.tell(app, troubles::stalled(&member.announcement, part));
                    }
                }
            }
            AppFact::Down { app } | AppFact::Stopped { app } | AppFact::Unregistered { app } => {
                self.audience.remove(app);
            }
            AppFact::Registered { .. } | AppFact::Handles { .. } | AppFact::GroupsChanged => {}
        }
    }

    /// The next order or fact; those for applications come after those for layers.
    pub(crate) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front().or_else(|| {
            let (to, event) = self.audience.next()?;
            Some(Output::Event { to, event })
        })
    }

    /// When [`Input::TimePassed`] is due.
    pub(crate) fn next_wake(&self) -> Option<Time> {
        let contests = self.contests.values().map(|contest| contest.until);
        let paces = self.paces.iter().flat_map(|pace| [pace.respite.map(|respite| respite.until), pace.due]);
        contests.chain(paces.flatten()).chain(self.audience.next_wake()).min()
    }

    /// What this node says about itself.
    pub(crate) const fn announcement(&self) -> &Announcement {
        &self.me
    }

    /// What of this node does not get on.
    pub(crate) const fn progress(&self) -> &Progress {
        &self.progress
    }

    /// Our own UDP addresses.
    pub(crate) fn paths(&self) -> &[SocketAddr] {
        &self.paths
    }

    /// What was refused.
    pub(crate) const fn refusals(&self) -> &Refusals {
        &self.refusals
    }

    /// The pace of who is in no group.
    fn rest(&self) -> &Pace {
        &self.paces[REST]
    }

    /// Asks `to`, whom there is a contact for.
    fn ask(&mut self, now: Time, to: Place) {
        let correlation = self.next_correlation();
        if let Some(mut contact) = self.contacts.get_mut(&to) {
            let pace = match contact.role {
                Role::Member(node) => self.members.get(&node).map_or(REST, |member| member.pace),
                Role::Candidate { .. } | Role::Former { .. } => REST,
            };
            contact.questions.push(Question { correlation, asked: now }, self.paces[pace].answerable());
            self.outputs.push_back(Output::SendQuery { to, correlation });
        }
    }

    /// A number that was not used before and cannot be guessed without the secret.
    fn next_correlation(&mut self) -> u64 {
        self.questions_asked += 1;
        let mut hasher = DefaultHasher::new();
        (self.secret, self.questions_asked).hash(&mut hasher);
        hasher.finish()
    }

    /// Other projects and our own echo are none of our business. // spec: NDL-1.2
    fn concerns_us(&mut self, now: Time, from: Place, announcement: &Announcement) -> bool {
        if announcement.project != self.me.project {
            self.recall.heard(now, from.there, announcement);
            return false;
        }
        // What was read just before its socket was closed came too late.
        announcement.boot_nonce != self.me.boot_nonce && self.paths.contains(&from.here)
    }
}
