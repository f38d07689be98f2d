//! Whether a barrier opened early, from what the parties wrote down.

use std::{collections::BTreeMap, time::Duration};

use super::PARTIES;
use crate::load::Times;

/// So long after a process was killed its arrival may still count, where nobody has looked when its loss was known: the connection that
/// breaks tells of it, within 20 ms on a quiet machine; the rest is for one that is busy.
pub(super) const HEARSAY: Duration = Duration::from_secs(10);

/// What a party wrote down, with the host's monotonic time in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// All that it requires was ready.
    Started(u64),
    /// It is about to arrive.
    Arrived(u64),
    /// It has passed this generation.
    Passed(u64, u64),
}

impl Event {
    /// Says it, in a line.
    pub fn tell(self) {
        match self {
            Self::Started(at) => println!("started {at}"),
            Self::Arrived(at) => println!("arrived {at}"),
            Self::Passed(at, generation) => println!("passed {at} {generation}"),
        }
    }

    /// What a line says; `None`: something else.
    #[must_use]
    pub fn read(line: &str) -> Option<Self> {
        let mut words = line.split(' ');
        let (what, at) = (words.next()?, words.next()?.parse().ok()?);
        match what {
            "started" => Some(Self::Started(at)),
            "arrived" => Some(Self::Arrived(at)),
            "passed" => Some(Self::Passed(at, words.next()?.parse().ok()?)),
            _ => None,
        }
    }
}

/// What one process wrote down, and when it was killed.
#[derive(Clone, Debug, Default)]
pub struct Life {
    /// In the order in which it happened.
    pub events: Vec<Event>,
    /// By the same clock.
    pub killed: Option<u64>,
    /// When all others were seen to know that it is lost, if that was looked at: from then on it counts for nobody.
    pub unknown: Option<u64>,
}

/// A wait of one life.
struct Visit {
    at: u64,
    passed: Option<(u64, u64)>,
}

/// A party's lives, each with its waits.
type Visits<'a> = Vec<(&'a Life, Vec<Visit>)>;

/// For which generation a wait that did not end has counted, by party and life: no wait counts for two.
type Counted = BTreeMap<(usize, usize), u64>;

/// What the judge found.
#[derive(Debug, Default)]
pub struct Verdict {
    /// What must not have happened, in words.
    pub violations: Vec<String>,
    /// Generations that all parties passed, each in one life.
    pub generations: usize,
    /// From the last arrival until the last one has gone on.
    pub release: Times,
    /// From the first one that goes on until the last one does.
    pub skew: Times,
    /// From a kill until somebody goes on for whom the killed one counted.
    pub hearsay: Times,
}

impl Life {
    pub(super) fn started(&self) -> Option<u64> {
        self.events.iter().find_map(|event| if let Event::Started(at) = event { Some(*at) } else { None })
    }

    /// Whether what it did at `then` may count at `at`.
    fn counts(&self, then: u64, at: u64) -> bool {
        let hearsay = |killed: u64| killed.saturating_add(HEARSAY.as_nanos() as u64);
        let end = self.unknown.or_else(|| self.killed.map(hearsay)).unwrap_or(u64::MAX);
        then <= at && at <= end
    }

    fn visits(&self) -> Vec<Visit> {
        let mut visits: Vec<Visit> = Vec::new();
        for event in &self.events {
            match *event {
                Event::Started(_) => {}
                Event::Arrived(at) => visits.push(Visit { at, passed: None }),
                Event::Passed(at, generation) => {
                    if let Some(visit) = visits.last_mut() {
                        visit.passed = Some((at, generation));
                    }
                }
            }
        }
        visits
    }
}

impl Verdict {
    /// Reads what all lives of all parties wrote down.
    #[must_use]
    pub fn of(parties: &[Vec<Life>]) -> Self {
        let mut verdict = Self::default();
        verdict.judge_starts(parties);
        let visits: Vec<Visits<'_>> =
            parties.iter().map(|lives| lives.iter().map(|life| (life, life.visits())).collect()).collect();
        for (index, lives) in visits.iter().enumerate() {
            lives.iter().for_each(|(_, of_life)| verdict.judge_order(index, of_life));
        }
        verdict.judge_passes(&visits);
        verdict.measure(&visits);
        verdict
    }

    /// Nobody starts before what it requires.
    fn judge_starts(&mut self, parties: &[Vec<Life>]) {
        for (index, lives) in parties.iter().enumerate() {
            for at in lives.iter().filter_map(Life::started) {
                let is_there = |other: usize| {
                    parties[other].iter().any(|life| life.started().is_some_and(|then| life.counts(then, at)))
                };
                for text in PARTIES[index].1 {
                    let requirement: sinew::app::Requirement = text.parse().expect("they are written by us");
                    let there = (0..PARTIES.len())
                        .filter(|other| requirement.counts(PARTIES[*other].0) && is_there(*other));
                    if there.count() < requirement.count() {
                        self.violations.push(format!("{} started at {at} without {text}", PARTIES[index].0));
                    }
                }
            }
        }
    }

    /// No life passes one generation twice, or a former one.
    fn judge_order(&mut self, index: usize, of_life: &[Visit]) {
        let mut last = 0;
        for (_, generation) in of_life.iter().filter_map(|visit| visit.passed) {
            if generation <= last {
                self.violations.push(format!("{} passed {generation} after {last}", PARTIES[index].0));
            }
            last = generation;
        }
    }

    /// Nobody passes a generation before all are there for that one.
    fn judge_passes(&mut self, visits: &[Visits<'_>]) {
        let of_party = |(index, lives): (usize, &Visits<'_>)| -> Vec<(u64, u64, usize)> {
            let passed = lives.iter().flat_map(|(_, of_life)| of_life).filter_map(|visit| visit.passed);
            passed.map(|(at, generation)| (generation, at, index)).collect()
        };
        let mut passes: Vec<(u64, u64, usize)> = visits.iter().enumerate().flat_map(of_party).collect();
        passes.sort_unstable();
        let mut counted = Counted::new();
        for (generation, at, index) in passes {
            for (other, lives) in visits.iter().enumerate() {
                if !self.was_there(lives, other, (generation, at), &mut counted) {
                    let [name, missing] = [index, other].map(|index| PARTIES[index].0);
                    self.violations.push(format!("{name} passed {generation} at {at} without {missing}"));
                }
            }
        }
    }

    /// Whether a party had arrived before `at` and passed just this generation; or had arrived, was killed before it could pass, and counts
    /// for no other one, nor has a later life of it passed one before this.
    fn was_there(
        &mut self,
        lives: &Visits<'_>,
        party: usize,
        (generation, at): (u64, u64),
        counted: &mut Counted,
    ) -> bool {
        let has_passed =
            |visit: &Visit| visit.at <= at && visit.passed.is_some_and(|(_, passed)| passed == generation);
        if lives.iter().flat_map(|(_, of_life)| of_life).any(has_passed) {
            return true;
        }
        // The latest first: whoever was there before it counts for no generation behind one that it has passed.
        for (number, (life, of_life)) in lives.iter().enumerate().rev() {
            let pending = of_life.last().filter(|visit| visit.passed.is_none());
            let counts = pending.is_some_and(|visit| life.counts(visit.at, at));
            if counts && *counted.entry((party, number)).or_insert(generation) == generation {
                if let Some(killed) = life.killed {
                    self.hearsay.note(Duration::from_nanos(at.saturating_sub(killed)));
                }
                return true;
            }
            let mut passed = of_life.iter().filter_map(|visit| visit.passed);
            if passed.any(|(_, passed)| passed < generation) {
                return false;
            }
        }
        false
    }

    fn measure(&mut self, visits: &[Visits<'_>]) {
        let all = |generation: u64| -> Option<Vec<(u64, u64)>> {
            let of_party = |lives: &Visits<'_>| {
                let mut passed = lives.iter().flat_map(|(_, visits)| visits);
                passed.find_map(|visit| {
                    visit.passed.filter(|(_, of)| *of == generation).map(|(at, _)| (visit.at, at))
                })
            };
            visits.iter().map(of_party).collect()
        };
        let passes = visits.iter().flatten().flat_map(|(_, visits)| visits).filter_map(|visit| visit.passed);
        let highest = passes.map(|(_, generation)| generation).max().unwrap_or_default();
        for times in (1..=highest).filter_map(all) {
            let arrived = times.iter().map(|(arrived, _)| *arrived).max().unwrap_or_default();
            let first = times.iter().map(|(_, passed)| *passed).min().unwrap_or_default();
            let last = times.iter().map(|(_, passed)| *passed).max().unwrap_or_default();
            self.generations += 1;
            self.release.note(Duration::from_nanos(last.saturating_sub(arrived)));
            self.skew.note(Duration::from_nanos(last - first));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn life(events: &[Event]) -> Life {
        Life { events: events.to_vec(), ..Life::default() }
    }

    /// All start and pass the first generation together; `change` makes it wrong.
    fn played(change: impl FnOnce(&mut Vec<Vec<Life>>)) -> Verdict {
        let mut parties: Vec<Vec<Life>> = (0..4)
            .map(|index| {
                vec![life(&[
                    Event::Started(10 + index),
                    Event::Arrived(20 + index),
                    Event::Passed(30 + index, 1),
                ])]
            })
            .collect();
        change(&mut parties);
        Verdict::of(&parties)
    }

    #[test]
    fn what_is_as_it_should_be_is_no_violation() {
        let verdict = played(|_| {});
        assert_eq!(verdict.violations, [""; 0]);
        assert_eq!((verdict.generations, verdict.skew.percentile(1.0)), (1, Duration::from_nanos(3)));
        assert_eq!(verdict.release.percentile(1.0), Duration::from_nanos(10));
    }

    #[test]
    fn each_sort_of_early_is_found() {
        let wrong: [fn(&mut Vec<Vec<Life>>); 5] = [
            |parties| parties[3][0].events[0] = Event::Started(5),
            |parties| parties[2][0].events[1] = Event::Arrived(40),
            |parties| parties[1][0].events[2..].clone_from_slice(&[Event::Passed(30, 0)]),
            |parties| parties[0][0].events.extend([Event::Arrived(50), Event::Passed(60, 1)]),
            // It was there once, and is counted for the next generation too.
            |parties| {
                parties[1..].iter_mut().for_each(|lives| {
                    lives[0].events.extend([Event::Arrived(50), Event::Passed(60, 2)]);
                })
            },
        ];
        for change in wrong {
            assert!(!played(change).violations.is_empty());
        }
    }

    /// The first party arrives and is killed; the others pass, the last of them at `at`.
    fn killed_while_it_waits(parties: &mut [Vec<Life>], at: u64) {
        parties[0][0].events.push(Event::Arrived(40));
        parties[0][0].killed = Some(50);
        for party in &mut parties[1..] {
            party[0].events.extend([Event::Arrived(41), Event::Passed(at, 2)]);
        }
    }

    #[test]
    fn what_a_killed_process_did_counts_until_its_loss_is_known() {
        let in_time = HEARSAY.as_nanos() as u64 + 50;
        let verdict = played(|parties| killed_while_it_waits(parties, in_time));
        assert_eq!((verdict.violations.as_slice(), verdict.hearsay.percentile(1.0)), (&[][..], HEARSAY));
        assert!(!played(|parties| killed_while_it_waits(parties, in_time + 1)).violations.is_empty());
    }

    #[test]
    fn what_a_killed_process_did_counts_no_more_once_all_were_seen_to_know_of_its_loss() {
        let passed_at = |at| {
            played(|parties| {
                killed_while_it_waits(parties, at);
                parties[0][0].unknown = Some(60);
            })
        };
        assert_eq!(passed_at(60).violations, [""; 0]);
        assert!(!passed_at(61).violations.is_empty());
    }

    #[test]
    fn a_killed_process_counts_for_one_generation_only() {
        let verdict = played(|parties| {
            killed_while_it_waits(parties, 60);
            for party in &mut parties[1..] {
                party[0].events.extend([Event::Arrived(70), Event::Passed(80, 3)]);
            }
        });
        assert_eq!(verdict.violations.len(), 3, "{:?}", verdict.violations);
        assert!(verdict.violations.iter().all(|violation| violation.contains("passed 3")));
    }

    #[test]
    fn a_killed_process_counts_no_more_once_the_next_life_of_its_party_has_passed() {
        let verdict = played(|parties| {
            // The first of these lives was killed, and nobody has counted it; the next one passes.
            parties[0][0].events.push(Event::Arrived(40));
            parties[0][0].killed = Some(50);
            parties[0].push(life(&[Event::Started(60), Event::Arrived(70), Event::Passed(80, 2)]));
            for party in &mut parties[1..] {
                let passes =
                    [Event::Arrived(71), Event::Passed(81, 2), Event::Arrived(90), Event::Passed(91, 3)];
                party[0].events.extend(passes);
            }
        });
        assert_eq!(verdict.violations.len(), 3, "{:?}", verdict.violations);
        assert!(verdict.violations.iter().all(|violation| violation.contains("passed 3")));
    }
}
