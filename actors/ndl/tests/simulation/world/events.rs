//! The planned events of processes and of the network, and the responses of hosts.

use super::*;

impl World {
    pub(super) fn step(&mut self, step: Step) {
        self.note(|| format!("{step:?}"));
        match step {
            Step::Start { node, elsewhere } => self.start(node, elsewhere),
            Step::Kill { node, refuses } => self.kill(node, refuses),
            Step::Leave { node } => self.leave(node),
            Step::RestartShell { node } => self.restart_shell(node),
            Step::Stall { node, lasts } => self.stall(node, lasts),
            Step::Cut { from, to, network } => {
                self.networks.cut(from, to, network);
                self.change(from, to);
            }
            Step::Mend { from, to, network } => {
                self.networks.mend(from, to, network);
                self.change(from, to);
            }
            Step::Muffle { from, to } => self.networks.muffle(from, to),
            Step::Unmuffle { from, to } => self.networks.unmuffle(from, to),
            Step::Trouble { node, trouble } => self.trouble(node, trouble),
            Step::Heal => self.heal(),
        }
    }

    /// Stalls an application of the node, or resumes it.
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
            Part { app: TROUBLED, name: "troubled".to_owned(), trouble: TroubleCode(trouble), since_ms: 300 }
        });
        let progress = Progress::of(part.into_iter().collect());
        self.with(process, |tested, now| tested.core.handle(now, Input::ProgressSeen(progress)));
    }

    fn change(&mut self, one: usize, other: usize) {
        self.changed.insert((one.min(other), one.max(other)), self.now());
    }

    fn change_node(&mut self, node: usize) {
        (0..self.plan.nodes).for_each(|other| self.change(node, other));
    }

    /// Returns the response of the host of `node` to the node of `process`.
    pub(super) fn host_of(&self, process: usize, node: usize) -> Host {
        let here = self.processes[process].node;
        if self.networks.is_apart(here, node) || self.dead_hosts.contains(&node) {
            Host::IsSilent
        } else if self.current.contains_key(&node) {
            Host::Accepts
        } else {
            Host::Refuses
        }
    }

    /// Returns the response at these addresses of its GNCL.
    pub(super) fn response_at(&self, process: usize, node: usize, to: &[SocketAddr]) -> Host {
        let response = |at: &SocketAddr| match self.plan.shared {
            Some(host) if at.ip() == SHARED => host,
            Some(_) | None => self.host_of(process, node),
        };
        if self.fault == Some(Fault::SharedAddressesProbed) {
            let responses: Vec<_> = self.gncl_addresses(node).map(|at| response(&at.into())).collect();
            let is_given = |host: &Host| responses.contains(host);
            return [Host::Accepts, Host::Refuses].into_iter().find(is_given).unwrap_or(Host::IsSilent);
        }
        Host::by(to.iter().map(response))
    }

    /// Returns the addresses that a node announces for its GNCL.
    fn gncl_addresses(&self, node: usize) -> impl Iterator<Item = SocketAddrV4> {
        let shared = self.plan.shared.map(|_| SocketAddrV4::new(SHARED, GNCL_PORT));
        std::iter::once(SocketAddrV4::new(ip(node, 0), GNCL_PORT)).chain(shared)
    }

    /// Returns the response of the host of `node`, if it has been the same for long enough to be known.
    pub(super) fn settled_host_of(&self, process: usize, node: usize) -> Option<Host> {
        let Process { node: here, stalled: (stalled_since, stalled_until), .. } = self.processes[process];
        let (period, missed_max) = match self.plan.watched {
            Some((watched, period, missed_max)) if watched == node => (period, missed_max),
            Some(_) | None => (self.plan.period, self.plan.missed_max),
        };
        let bound = self.plan.silence_max(period, missed_max);
        let was_stalled = stalled_since != Time::ZERO && stalled_until + bound > self.now();
        let changed = self.changed.get(&(here.min(node), here.max(node)));
        let late = self.plan.lateness + self.plan.always_late;
        let is_new = changed.is_some_and(|at| *at + (period + late) * 2 + REPORT_DELAY_MAX > self.now());
        (!was_stalled && !is_new).then(|| self.host_of(process, node))
    }

    /// Requests a liveness hint from the other's GNCL within this time, if the connection delivers.
    pub(super) fn request_liveness(&mut self, process: usize, node: NodeAddress, within: Duration) {
        let Some(other) = self.current_of(node).filter(|other| !self.is_stalled(*other)) else { return };
        let is_up =
            self.plan.connections && self.host_of(process, self.processes[other].node) == Host::Accepts;
        if is_up {
            let delay = self.chance.between(Duration::ZERO, within);
            self.queue.push_after(delay, Event::Hint(process, other));
        }
    }

    pub(super) fn hint_arrives(&mut self, process: usize, of: usize) {
        if self.is_stalled(process) {
            let (_, until) = self.processes[process].stalled;
            self.queue.push(until, Event::Hint(process, of));
        } else if self.processes[process].is_alive {
            self.note(|| format!("{process} reads of {of} on their connection"));
            self.hints.insert((process, of), self.local(process));
            self.judge.hint_read(self.now(), process, of);
            self.coverage.count("liveness hints");
        }
    }

    /// Returns GNCL's liveness hints for the members that a process is about to lose.
    pub(super) fn hints_in_doubt(&self, process: usize) -> Vec<Input> {
        let hint = |(node, incarnation)| {
            let of = self.judge.process_of(node, incarnation)?;
            let at = *self.hints.get(&(process, of))?;
            Some(Input::HintReceived { node, incarnation, at })
        };
        self.processes[process].tested.core.in_doubt().into_iter().filter_map(hint).collect()
    }

    /// Returns whether the connection with this incarnation of a node has delivered for so long that a hint must be
    /// known.
    pub(super) fn has_delivered(
        &self,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
    ) -> bool {
        let Some(other) = self.current_of(node) else { return false };
        let Process { node: index, stalled: (_, stalled_until), ref tested, .. } = self.processes[other];
        let late = self.plan.lateness + self.plan.always_late;
        let runs = stalled_until + (self.plan.period + late) * 4 <= self.now();
        let is_that_incarnation = tested.core.announcement().incarnation == incarnation;
        self.plan.connections
            && is_that_incarnation
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
        let port = if elsewhere { PORT + 1 + u16::try_from(index).expect("few incarnations") } else { PORT };
        let addresses: Vec<_> =
            (0..self.plan.networks).map(|network| SocketAddr::from((ip(node, network), port))).collect();
        let (nonce, secret) = (self.chance.draw(), u128::from(self.chance.draw()));
        let tested =
            TestedCore::new(self.config(node), node_address(node), incarnation, (nonce, secret), self.fault);
        self.processes.push(Process {
            node,
            tested,
            addresses: addresses.clone(),
            clock: self.plan.clocks[node],
            is_alive: true,
            stall: Stall::new(SOCKET_MAX),
            stalled: (Time::ZERO, Time::ZERO),
            wake: None,
            wakes_for: Time::ZERO,
            met: BTreeSet::new(),
            leaves: BTreeSet::new(),
            troubles: Truth::default(),
        });
        self.current.insert(node, index);
        self.dead_hosts.remove(&node);
        self.change_node(node);
        self.at.extend(addresses.iter().map(|address| (*address, index)));
        self.judge.started(node_address(node), incarnation, addresses);
        self.listeners.started();
        let listens = AppFact::Ready { app: LISTENER };
        self.with(index, |tested, now| tested.core.handle(now, Input::AppChanged(listens)));
        self.begin(index);
        self.report_by_mdns(index);
    }

    fn begin(&mut self, process: usize) {
        let Process { ref addresses, node, .. } = self.processes[process];
        let own: Vec<_> =
            self.plan.shared.map(|_| SocketAddr::from((SHARED, GNCL_PORT))).into_iter().collect();
        let gncl = self.gncl_addresses(node).collect();
        let paths = addresses.clone();
        self.with(process, |tested, now| {
            tested.core.use_local_addresses(&own);
            tested.core.announce_gncl((gncl, None));
            tested.core.start(now, &paths);
        });
    }

    fn restart_shell(&mut self, node: usize) {
        let Some(process) = self.current.get(&node).copied() else { return };
        if !self.is_stalled(process) {
            self.judge.shell_restarted(process, self.now());
            self.begin(process);
        }
    }

    /// Reports the newcomer to every node by mDNS, and every node to it.
    fn report_by_mdns(&mut self, newcomer: usize) {
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
        let delay = self.chance.between(Duration::ZERO, REPORT_DELAY_MAX);
        let address = self.processes[other].addresses[0];
        let input = Box::new(Input::AddressNamed { source: Source::Mdns, address });
        self.queue.push_after(delay, Event::Input(process, input));
    }

    fn kill(&mut self, node: usize, refuses: bool) {
        let Some(process) = self.end(node) else { return };
        if !refuses {
            self.dead_hosts.insert(node);
            return;
        }
        // Its host refuses connections from now on.
        let incarnation = self.processes[process].tested.core.announcement().incarnation;
        let (node_address, others) = (node_address(node), self.current.clone());
        for (other, index) in others {
            if self.networks.is_apart(other, node) {
                continue;
            }
            let at = self.now() + self.chance.between(Duration::ZERO, REPORT_DELAY_MAX);
            let broken = LinkFact::LinkBroken { node: node_address, incarnation };
            let refused = LinkFact::DialRefused { node: node_address, incarnation };
            self.queue.push(at, Event::Input(index, Box::new(Input::Link(broken))));
            self.queue.push(at + REPORT_DELAY_MAX, Event::Input(index, Box::new(Input::Link(refused))));
        }
    }

    fn leave(&mut self, node: usize) {
        let Some(process) = self.current.get(&node).copied() else { return };
        if self.is_stalled(process) {
            return;
        }
        self.with(process, |tested, now| tested.core.handle(now, Input::Stopping));
        let leaves = std::mem::take(&mut self.processes[process].leaves);
        self.judge.left(self.now(), process, &leaves);
        self.end(node);
    }

    fn end(&mut self, node: usize) -> Option<usize> {
        let index = self.current.remove(&node)?;
        self.processes[index].is_alive = false;
        self.change_node(node);
        self.at.retain(|_, at| *at != index);
        self.judge.ended(index, self.now());
        Some(index)
    }

    fn stall(&mut self, node: usize, lasts: Duration) {
        let Some(index) = self.current.get(&node).copied().filter(|process| !self.is_stalled(*process))
        else {
            return;
        };
        let (now, until) = (self.now(), self.now() + lasts);
        let process = &mut self.processes[index];
        process.stall.pause(until);
        process.stalled = (now, until);
        self.judge.stalled(index, now, lasts);
        self.coverage.count("stalls");
        self.queue.push(until, Event::Resume(index));
    }

    fn heal(&mut self) {
        self.networks.heal();
        (0..self.plan.nodes).for_each(|node| self.change_node(node));
        if self.plan.finding != Finding::Mdns {
            return;
        }
        // mDNS repeats its records; here only those that have not been used yet.
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
