//! What happens to processes and to the network, as the plan says.

use super::*;

impl World {
    pub(super) fn strike(&mut self, what: Happening) {
        self.trace(|| format!("{what:?}"));
        match what {
            Happening::Start { node, elsewhere } => self.start(node, elsewhere),
            Happening::Kill { node, refuses } => self.kill(node, refuses),
            Happening::Leave { node } => self.leave(node),
            Happening::RestartShell { node } => self.restart_shell(node),
            Happening::Stall { node, lasts } => self.stall(node, lasts),
            Happening::Cut { from, to, network } => {
                self.network.cut(from, to, network);
                self.change(from, to);
            }
            Happening::Mend { from, to, network } => {
                self.network.mend(from, to, network);
                self.change(from, to);
            }
            Happening::Muffle { from, to } => self.network.muffle(from, to),
            Happening::Unmuffle { from, to } => self.network.unmuffle(from, to),
            Happening::Trouble { node, trouble } => self.trouble(node, trouble),
            Happening::Heal => self.heal(),
        }
    }

    /// An application of the node does not get on, or gets on again.
    fn trouble(&mut self, node: usize, trouble: Option<Trouble>) {
        let Some(process) = self.current.get(&node).copied().filter(|process| !self.is_stalled(*process))
        else {
            return;
        };
        let troubles = &mut self.processes[process].troubles;
        troubles.now.clear();
        let part = trouble.map(|trouble| {
            troubles.now.insert(TROUBLED, trouble);
            troubles.ever.push((TROUBLED, trouble));
            Part { app: TROUBLED, name: "troubled".to_owned(), trouble: Told(trouble), since_ms: 300 }
        });
        let progress = Progress::of(part.into_iter().collect());
        self.with(process, |patient, now| patient.core.handle(now, Input::ProgressSeen(progress)));
    }

    fn change(&mut self, one: usize, other: usize) {
        self.changed.insert((one.min(other), one.max(other)), self.now);
    }

    fn change_node(&mut self, node: usize) {
        (0..self.plan.nodes).for_each(|other| self.change(node, other));
    }

    /// What the host of `node` says to the node of `process`.
    pub(super) fn host_of(&self, process: usize, node: usize) -> Host {
        let here = self.processes[process].node;
        if self.network.is_apart(here, node) || self.dead_hosts.contains(&node) {
            Host::IsSilent
        } else if self.current.contains_key(&node) {
            Host::Accepts
        } else {
            Host::Refuses
        }
    }

    /// What is said at these addresses of its GNCL.
    pub(super) fn said_of(&self, process: usize, node: usize, to: &[SocketAddr]) -> Host {
        let said = to.iter().map(|at| match self.plan.shared {
            Some(host) if at.ip() == SHARED => host,
            Some(_) | None => self.host_of(process, node),
        });
        if self.fault == Some(Fault::TakesAnybodysWord) {
            let said: Vec<_> = said.collect();
            let is_said = |host: &Host| said.contains(host);
            return [Host::Accepts, Host::Refuses].into_iter().find(is_said).unwrap_or(Host::IsSilent);
        }
        Host::by(said)
    }

    /// The same, if that has been so for long enough to be known.
    pub(super) fn settled_host_of(&self, process: usize, node: usize) -> Option<Host> {
        let Process { node: here, stalled_since, stalled_until, .. } = self.processes[process];
        let (period, missed_max) = match self.plan.watched {
            Some((watched, period, missed_max)) if watched == node => (period, missed_max),
            Some(_) | None => (self.plan.period, self.plan.missed_max),
        };
        let bound = self.plan.silence_max(period, missed_max);
        let was_stalled = stalled_since != Time::ZERO && stalled_until + bound > self.now;
        let changed = self.changed.get(&(here.min(node), here.max(node)));
        let late = self.plan.lateness + self.plan.always_late;
        let is_new = changed.is_some_and(|at| *at + (period + late) * 2 + WORD_MAX > self.now);
        (!was_stalled && !is_new).then(|| self.host_of(process, node))
    }

    /// Has the other's GNCL give a sign within this time, if the connection delivers.
    pub(super) fn ask_for_a_sign(&mut self, process: usize, node: NodeAddress, within: Duration) {
        let Some(other) = self.current_of(node).filter(|other| !self.is_stalled(*other)) else { return };
        let is_up =
            self.plan.connections && self.host_of(process, self.processes[other].node) == Host::Accepts;
        if is_up {
            let at = self.now + self.chance.between(Duration::ZERO, within);
            self.push(at, Event::Sign(process, other));
        }
    }

    pub(super) fn read_a_sign(&mut self, process: usize, of: usize) {
        if self.is_stalled(process) {
            let until = self.processes[process].stalled_until;
            self.push(until, Event::Sign(process, of));
        } else if self.processes[process].is_alive {
            self.trace(|| format!("{process} reads of {of} on their connection"));
            self.signs.insert((process, of), self.local(process));
            self.judge.read_a_sign(self.now, process, of);
            self.seen.signs += 1;
        }
    }

    /// What GNCL knows of those that a process is about to lose.
    pub(super) fn signs_in_doubt(&self, process: usize) -> Vec<Input> {
        let sign = |(node, incarnation)| {
            let of = self.judge.life(node, incarnation)?;
            let at = *self.signs.get(&(process, of))?;
            Some(Input::SignSeen { node, incarnation, at })
        };
        self.processes[process].patient.core.in_doubt().into_iter().filter_map(sign).collect()
    }

    /// Whether the connection with this life of a node has delivered for so long that a sign must be known.
    pub(super) fn has_delivered(
        &self,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
    ) -> bool {
        let Some(other) = self.current_of(node) else { return false };
        let Process { node: index, stalled_until, ref patient, .. } = self.processes[other];
        let late = self.plan.lateness + self.plan.always_late;
        let runs = stalled_until + (self.plan.period + late) * 4 <= self.now;
        let is_that_life = patient.core.announcement().incarnation == incarnation;
        self.plan.connections
            && is_that_life
            && runs
            && self.settled_host_of(process, index) == Some(Host::Accepts)
    }

    fn config(&self, node: usize) -> NodeConfig {
        let mut config = NodeConfig::new(format!("node-{node}"));
        config.ndl.period = self.plan.period;
        config.ndl.missed_max = self.plan.missed_max;
        if let Some((watched, period, missed_max)) = self.plan.watched {
            let nodes = vec![format!("node-{watched}")];
            config.ndl.watch = vec![WatchGroup { nodes, period, missed_max }];
        }
        config.ndl.nodes_max = 64.max(self.plan.nodes + 16);
        if self.plan.finding != Finding::Group {
            config.ndl.multicast = None;
        }
        if self.plan.finding == Finding::Seeds {
            config.ndl.seeds = (0..self.plan.nodes)
                .filter(|other| *other != node)
                .map(|other| SocketAddr::from((ip(other, 0), PORT)).into())
                .collect();
        }
        config
    }

    fn start(&mut self, node: usize, elsewhere: bool) {
        if self.current.contains_key(&node) {
            return;
        }
        let index = self.processes.len();
        let incarnation = Incarnation(index as u64 + 1);
        let port = if elsewhere { PORT + 1 + u16::try_from(index).expect("few lives") } else { PORT };
        let addresses: Vec<_> =
            (0..self.plan.networks).map(|network| SocketAddr::from((ip(node, network), port))).collect();
        let (nonce, secret) = (self.chance.draw(), u128::from(self.chance.draw()));
        let core = Core::new(&self.config(node), node_address(node), incarnation, nonce, secret);
        self.processes.push(Process {
            node,
            patient: Patient::new(core, self.fault),
            addresses: addresses.clone(),
            clock: self.plan.clocks[node],
            is_alive: true,
            stalled_until: Time::ZERO,
            stalled_since: Time::ZERO,
            socket: VecDeque::new(),
            wake: None,
            wakes_for: Time::ZERO,
            met: BTreeSet::new(),
            goodbyes: BTreeSet::new(),
            troubles: Truth::default(),
        });
        self.current.insert(node, index);
        self.dead_hosts.remove(&node);
        self.change_node(node);
        self.at.extend(addresses.iter().map(|address| (*address, index)));
        self.judge.started(node_address(node), incarnation, addresses);
        self.listeners.started();
        let listens = AppFact::Ready { app: LISTENER };
        self.with(index, |patient, now| patient.core.handle(now, Input::AppChanged(listens)));
        self.begin(index);
        self.tell_through_mdns(index);
    }

    fn begin(&mut self, process: usize) {
        let Process { ref addresses, node, .. } = self.processes[process];
        let shared = self.plan.shared.map(|_| SocketAddrV4::new(SHARED, GNCL_PORT));
        let own: Vec<_> = shared.into_iter().map(SocketAddr::from).collect();
        let gncl = std::iter::once(SocketAddrV4::new(ip(node, 0), GNCL_PORT)).chain(shared).collect();
        let paths = addresses.clone();
        self.with(process, |patient, now| {
            patient.core.use_own(&own);
            patient.core.announce_gncl((gncl, None));
            patient.core.start(now, &paths);
        });
    }

    fn restart_shell(&mut self, node: usize) {
        let Some(process) = self.current.get(&node).copied() else { return };
        if self.processes[process].stalled_until <= self.now {
            self.judge.shell_restarted(process, self.now);
            self.begin(process);
        }
    }

    /// Everybody learns of the newcomer, and it of everybody.
    fn tell_through_mdns(&mut self, newcomer: usize) {
        if self.plan.finding != Finding::Mdns {
            return;
        }
        let others: Vec<usize> = self.current.values().copied().filter(|other| *other != newcomer).collect();
        for other in others {
            self.resolve(other, newcomer);
            self.resolve(newcomer, other);
        }
    }

    fn resolve(&mut self, process: usize, other: usize) {
        let at = self.now + self.chance.between(Duration::ZERO, WORD_MAX);
        let address = self.processes[other].addresses[0];
        self.push(
            at,
            Event::Tell(
                process,
                Box::new(Input::AddressNamed { source: crate::ndl::core::Source::Mdns, address }),
            ),
        );
    }

    fn kill(&mut self, node: usize, refuses: bool) {
        let Some(process) = self.end(node) else { return };
        if !refuses {
            self.dead_hosts.insert(node);
            return;
        }
        // Its host refuses connections from now on.
        let incarnation = self.processes[process].patient.core.announcement().incarnation;
        let (node_address, others) = (node_address(node), self.current.clone());
        for (other, index) in others {
            if self.network.is_apart(other, node) {
                continue;
            }
            let at = self.now + self.chance.between(Duration::ZERO, WORD_MAX);
            let broken = LinkFact::LinkBroken { node: node_address, incarnation };
            let refused = LinkFact::DialRefused { node: node_address, incarnation };
            self.push(at, Event::Tell(index, Box::new(Input::Link(broken))));
            self.push(at + WORD_MAX, Event::Tell(index, Box::new(Input::Link(refused))));
        }
    }

    fn leave(&mut self, node: usize) {
        let Some(process) = self.current.get(&node).copied() else { return };
        if self.processes[process].stalled_until > self.now {
            return;
        }
        self.with(process, |patient, now| patient.core.handle(now, Input::Stopping));
        let goodbyes = std::mem::take(&mut self.processes[process].goodbyes);
        self.judge.said_goodbye(self.now, process, &goodbyes);
        self.end(node);
    }

    fn end(&mut self, node: usize) -> Option<usize> {
        let index = self.current.remove(&node)?;
        let process = &mut self.processes[index];
        process.is_alive = false;
        self.change_node(node);
        let process = &mut self.processes[index];
        process.socket.clear();
        self.at.retain(|_, at| *at != index);
        self.judge.ended(index, self.now);
        Some(index)
    }

    fn stall(&mut self, node: usize, lasts: Duration) {
        let Some(index) = self.current.get(&node).copied() else { return };
        let process = &mut self.processes[index];
        if process.stalled_until > self.now {
            return;
        }
        (process.stalled_since, process.stalled_until) = (self.now, self.now + lasts);
        let until = process.stalled_until;
        self.judge.stalled(index, self.now, lasts);
        self.seen.stalls += 1;
        self.push(until, Event::Resume(index));
    }

    fn heal(&mut self) {
        self.network.heal();
        (0..self.plan.nodes).for_each(|node| self.change_node(node));
        if self.plan.finding != Finding::Mdns {
            return;
        }
        // mDNS says its records again, and again; here only what was not of use yet.
        let living: Vec<usize> = self.current.values().copied().collect();
        for process in &living {
            for other in living.iter().filter(|other| *other != process) {
                if !self.processes[*process].met.contains(&self.processes[*other].addresses[0]) {
                    self.resolve(*process, *other);
                }
            }
        }
    }
}
