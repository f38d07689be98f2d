//! What other nodes say of barriers, and when our word goes to them.

use super::*;

/// Time between two of our words to a peer when nothing changed.
const REPEAT: Duration = Duration::from_secs(2);
/// Least time between two of them: who passes again and again costs a thousand frames a second, not one each.
const SPACING: Duration = Duration::from_millis(1);

/// The other nodes, as far as barriers go.
#[derive(Debug)]
pub(super) struct Voices(BTreeMap<NodeAddress, Voice>);

#[derive(Debug, Default)]
struct Voice {
    said: Option<Said>,
    /// Whether it said so since the link came up.
    heard: bool,
    sent: Option<Time>,
    due: Option<Time>,
}

/// What a node said last.
#[derive(Debug)]
struct Said {
    incarnation: Incarnation,
    version: u64,
    barriers: BTreeMap<Key, BarrierSaid>,
}

impl Voices {
    pub(super) const fn new() -> Self {
        Self(BTreeMap::new())
    }

    /// Messages can flow to `node`.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress, has_news: bool) {
        self.0.entry(node).or_default().due = has_news.then_some(now);
    }

    /// What `node` said does not count before it says it again. Our word is due there as before: it may be linked, in a life of which nothing
    /// was heard yet.
    pub(super) fn silent(&mut self, node: NodeAddress) {
        if let Some(voice) = self.0.get_mut(&node) {
            voice.heard = false;
        }
    }

    pub(super) fn retain(&mut self, is_known: impl Fn(NodeAddress) -> bool) {
        self.0.retain(|node, _| is_known(*node));
    }

    /// Keeps what a node says, whose linked life is `linked`, and returns what of it may be news. spec: SYNC-11
    ///
    /// # Errors
    /// Why it is not used.
    pub(super) fn hear(
        &mut self,
        from: NodeAddress,
        said: Arrivals,
        linked: Option<Incarnation>,
    ) -> Result<Vec<BarrierSaid>, &'static str> {
        if linked.is_some_and(|life| life != said.incarnation) {
            return Err("this is about another life of its node than the one that is linked");
        }
        let voice = self.0.entry(from).or_default();
        // Of two lives the linked one is right, be it the elder: the other one was a double of it.
        let is_over = |known: &&Said| linked.is_some() && known.incarnation != said.incarnation;
        let known = voice.said.as_ref().filter(|known| !is_over(known));
        let known = known.map(|known| (known.incarnation, known.version));
        if known.is_some_and(|known| (said.incarnation, said.version) < known) {
            return Ok(Vec::new());
        }
        voice.heard = true;
        if known == Some((said.incarnation, said.version)) {
            return Ok(Vec::new());
        }
        let barriers = said.barriers.iter().map(|barrier| (barrier.key(), barrier.clone())).collect();
        voice.said = Some(Said { incarnation: said.incarnation, version: said.version, barriers });
        Ok(said.barriers)
    }

    /// What each node said last of one barrier.
    pub(super) fn about(&self, key: &Key) -> impl Iterator<Item = &BarrierSaid> {
        self.0.values().filter_map(|voice| voice.said.as_ref()?.barriers.get(key))
    }

    /// Who waits at a barrier behind `generation`, on the nodes that can be heard. `linked` gives the life of such a node.
    pub(super) fn waiting(
        &self,
        key: &Key,
        generation: u64,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> impl Iterator<Item = (Member, &str)> {
        let heard = self.0.iter().filter(|(_, voice)| voice.heard).filter_map(move |(node, voice)| {
            let said = voice.said.as_ref().filter(|said| linked(*node) == Some(said.incarnation))?;
            Some((*node, said.incarnation, said.barriers.get(key)?))
        });
        heard.flat_map(move |(node, incarnation, barrier)| {
            let there = barrier.arrivals.iter().filter(move |arrival| arrival.after == generation);
            there.map(move |arrival| {
                let member = Member { node, incarnation, party: arrival.party };
                (member, arrival.name.as_deref().unwrap_or_default())
            })
        })
    }

    /// The generation of a barrier that a member's node is known to know. A life that is over needs to know nothing: it is over where a later one
    /// is heard. Where none is, the clock of the node's host may have begun anew, and this life came after that one. spec: SYNC-12
    pub(super) fn knows(
        &self,
        here: (NodeAddress, Incarnation),
        own: u64,
        key: &Key,
        member: &Member,
    ) -> u64 {
        if member.node == here.0 {
            return if member.incarnation == here.1 { own } else { u64::MAX };
        }
        let Some(voice) = self.0.get(&member.node) else { return 0 };
        let Some(said) = &voice.said else { return 0 };
        match said.incarnation.cmp(&member.incarnation) {
            std::cmp::Ordering::Less => 0,
            std::cmp::Ordering::Equal => said.barriers.get(key).map_or(0, |barrier| barrier.generation),
            std::cmp::Ordering::Greater if voice.heard => u64::MAX,
            std::cmp::Ordering::Greater => 0,
        }
    }

    /// Our word changed: it goes to every linked node, at once or when the least time has passed.
    pub(super) fn make_due(&mut self, now: Time) {
        for voice in self.0.values_mut() {
            let earliest = voice.sent.map_or(now, |sent| now.max(sent + SPACING));
            voice.due = Some(voice.due.map_or(earliest, |due| due.min(earliest)));
        }
    }

    /// What our word did not reach is said again soon.
    pub(super) fn not_taken(&mut self, now: Time, node: NodeAddress) {
        if let Some(voice) = self.0.get_mut(&node) {
            voice.due = Some(now + super::super::barrier::RETRY);
        }
    }

    /// The linked nodes to which our word goes now.
    pub(super) fn take_due(
        &mut self,
        now: Time,
        has_news: bool,
        is_linked: impl Fn(NodeAddress) -> bool,
    ) -> Vec<NodeAddress> {
        let mut due = Vec::new();
        for (node, voice) in &mut self.0 {
            if voice.due.is_none_or(|due| due > now) {
                continue;
            }
            let goes = has_news && is_linked(*node);
            voice.due = goes.then(|| now + REPEAT);
            if goes {
                voice.sent = Some(now);
                due.push(*node);
            }
        }
        due
    }

    /// When our word goes to a node next.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.0.values().filter_map(|voice| voice.due).min()
    }
}

impl BarrierSaid {
    /// What tells this barrier from others.
    pub(super) fn key(&self) -> Key {
        Key { name: self.name.clone(), parties: self.parties.iter().map(ToString::to_string).collect() }
    }
}
