//! Checks the records of the parties for a barrier that opened early.

use std::{collections::BTreeMap, time::Duration};

use super::PARTIES;
use sinew_testkit::report::Times;

/// Time after the kill of a process in which its arrival may still count, if the time at which its loss was
/// known was not recorded. The broken connection reveals the loss, within 20 ms on a quiet machine; the rest
/// is for a busy one.
pub(super) const HEARSAY: Duration = Duration::from_secs(10);

/// A recorded event, with the host's monotonic time in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// All its requirements were ready.
    Started(u64),
    /// It is about to arrive.
    Arrived(u64),
    /// It has passed this generation.
    Passed(u64, u64),
}

impl Event {
    /// Prints it as a line.
    pub fn print(self) {
        match self {
            Self::Started(at) => println!("started {at}"),
            Self::Arrived(at) => println!("arrived {at}"),
            Self::Passed(at, generation) => println!("passed {at} {generation}"),
        }
    }

    /// Parses a line; `None` if it is not an event.
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

/// The record of one process, and the time at which it was killed.
#[derive(Clone, Debug, Default)]
pub struct Incarnation {
    /// In chronological order.
    pub events: Vec<Event>,
    /// On the same clock.
    pub killed: Option<u64>,
    /// The time at which all others were seen to know of its loss, if this was checked. From then on it does
    /// not count.
    pub unknown: Option<u64>,
}

/// A wait of one incarnation.
struct Visit {
    at: u64,
    passed: Option<(u64, u64)>,
}

/// A party's incarnations, each with its waits.
type Visits<'a> = Vec<(&'a Incarnation, Vec<Visit>)>;

/// The generation for which an unfinished wait has counted, by party and incarnation: no wait counts for two.
type Counted = BTreeMap<(usize, usize), u64>;

/// The result of the judge.
#[derive(Debug, Default)]
pub struct Verdict {
    /// Descriptions of the violations.
    pub violations: Vec<String>,
    /// Number of generations that all parties passed, each in one incarnation.
    pub generations: usize,
    /// Time from the last arrival until the last party continued.
    pub release: Times,
    /// Time between the first and the last party to continue.
    pub skew: Times,
    /// Time from a kill until a party continued that still counted the killed one.
    pub hearsay: Times,
}

impl Incarnation {
    pub(super) fn started(&self) -> Option<u64> {
        self.events.iter().find_map(|event| if let Event::Started(at) = event { Some(*at) } else { None })
    }

    /// Returns whether an event of this incarnation at `then` may count at `at`.
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
    /// Evaluates the records of all incarnations of all parties.
    #[must_use]
    pub fn of(parties: &[Vec<Incarnation>]) -> Self {
        let mut verdict = Self::default();
        verdict.judge_starts(parties);
        let visits: Vec<Visits<'_>> = parties
            .iter()
            .map(|incarnations| {
                incarnations.iter().map(|incarnation| (incarnation, incarnation.visits())).collect()
            })
            .collect();
        for (index, incarnations) in visits.iter().enumerate() {
            incarnations.iter().for_each(|(_, of_incarnation)| verdict.judge_order(index, of_incarnation));
        }
        verdict.judge_passes(&visits);
        verdict.measure(&visits);
        verdict
    }

    /// Checks that no party starts before its requirements are ready.
    fn judge_starts(&mut self, parties: &[Vec<Incarnation>]) {
        for (index, incarnations) in parties.iter().enumerate() {
            for at in incarnations.iter().filter_map(Incarnation::started) {
                let is_there = |other: usize| {
                    parties[other].iter().any(|incarnation| {
                        incarnation.started().is_some_and(|then| incarnation.counts(then, at))
                    })
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

    /// Checks that no incarnation passes a generation twice, or an earlier one.
    fn judge_order(&mut self, index: usize, of_incarnation: &[Visit]) {
        let mut last = 0;
        for (_, generation) in of_incarnation.iter().filter_map(|visit| visit.passed) {
            if generation <= last {
                self.violations.push(format!("{} passed {generation} after {last}", PARTIES[index].0));
            }
            last = generation;
        }
    }

    /// Checks that no party passes a generation before all have arrived for it.
    fn judge_passes(&mut self, visits: &[Visits<'_>]) {
        let of_party = |(index, incarnations): (usize, &Visits<'_>)| -> Vec<(u64, u64, usize)> {
            let passed = incarnations
                .iter()
                .flat_map(|(_, of_incarnation)| of_incarnation)
                .filter_map(|visit| visit.passed);
            passed.map(|(at, generation)| (generation, at, index)).collect()
        };
        let mut passes: Vec<(u64, u64, usize)> = visits.iter().enumerate().flat_map(of_party).collect();
        passes.sort_unstable();
        let mut counted = Counted::new();
        for (generation, at, index) in passes {
            for (other, incarnations) in visits.iter().enumerate() {
                if !self.was_there(incarnations, other, (generation, at), &mut counted) {
                    let [name, missing] = [index, other].map(|index| PARTIES[index].0);
                    self.violations.push(format!("{name} passed {generation} at {at} without {missing}"));
                }
            }
        }
    }

    /// Returns whether a party was present for this generation at `at`. Either it arrived before and passed
    /// exactly this generation. Or it arrived, was killed before it could pass, and counts for no other
    /// generation, and no later incarnation of it passed an earlier one.
    fn was_there(
        &mut self,
        incarnations: &Visits<'_>,
        party: usize,
        (generation, at): (u64, u64),
        counted: &mut Counted,
    ) -> bool {
        let has_passed =
            |visit: &Visit| visit.at <= at && visit.passed.is_some_and(|(_, passed)| passed == generation);
        if incarnations.iter().flat_map(|(_, of_incarnation)| of_incarnation).any(has_passed) {
            return true;
        }
        // The latest first: earlier incarnations do not count for a generation after one that a later
        // incarnation has passed.
        for (number, (incarnation, of_incarnation)) in incarnations.iter().enumerate().rev() {
            let pending = of_incarnation.last().filter(|visit| visit.passed.is_none());
            let counts = pending.is_some_and(|visit| incarnation.counts(visit.at, at));
            if counts && *counted.entry((party, number)).or_insert(generation) == generation {
                if let Some(killed) = incarnation.killed {
                    self.hearsay.note(Duration::from_nanos(at.saturating_sub(killed)));
                }
                return true;
            }
            let mut passed = of_incarnation.iter().filter_map(|visit| visit.passed);
            if passed.any(|(_, passed)| passed < generation) {
                return false;
            }
        }
        false
    }

    fn measure(&mut self, visits: &[Visits<'_>]) {
        let all = |generation: u64| -> Option<Vec<(u64, u64)>> {
            let of_party = |incarnations: &Visits<'_>| {
                let mut passed = incarnations.iter().flat_map(|(_, visits)| visits);
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

    fn incarnation(events: &[Event]) -> Incarnation {
        Incarnation { events: events.to_vec(), ..Incarnation::default() }
    }

    /// All start and pass the first generation together; `change` makes it wrong.
    fn played(change: impl FnOnce(&mut Vec<Vec<Incarnation>>)) -> Verdict {
        let mut parties: Vec<Vec<Incarnation>> = (0..4)
            .map(|index| {
                vec![incarnation(&[
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
    fn correct_history_has_no_violation() {
        let verdict = played(|_| {});
        assert_eq!(verdict.violations, [""; 0]);
        assert_eq!((verdict.generations, verdict.skew.percentile(1.0)), (1, Duration::from_nanos(3)));
        assert_eq!(verdict.release.percentile(1.0), Duration::from_nanos(10));
    }

    #[test]
    fn each_kind_of_early_opening_is_found() {
        let wrong: [fn(&mut Vec<Vec<Incarnation>>); 5] = [
            |parties| parties[3][0].events[0] = Event::Started(5),
            |parties| parties[2][0].events[1] = Event::Arrived(40),
            |parties| parties[1][0].events[2..].clone_from_slice(&[Event::Passed(30, 0)]),
            |parties| parties[0][0].events.extend([Event::Arrived(50), Event::Passed(60, 1)]),
            // It arrived once, and is also counted for the next generation.
            |parties| {
                parties[1..].iter_mut().for_each(|incarnations| {
                    incarnations[0].events.extend([Event::Arrived(50), Event::Passed(60, 2)]);
                })
            },
        ];
        for change in wrong {
            assert!(!played(change).violations.is_empty());
        }
    }

    /// The first party arrives and is killed; the others pass, the last of them at `at`.
    fn killed_while_it_waits(parties: &mut [Vec<Incarnation>], at: u64) {
        parties[0][0].events.push(Event::Arrived(40));
        parties[0][0].killed = Some(50);
        for party in &mut parties[1..] {
            party[0].events.extend([Event::Arrived(41), Event::Passed(at, 2)]);
        }
    }

    #[test]
    fn arrival_of_killed_process_counts_until_loss_is_known() {
        let in_time = HEARSAY.as_nanos() as u64 + 50;
        let verdict = played(|parties| killed_while_it_waits(parties, in_time));
        assert_eq!((verdict.violations.as_slice(), verdict.hearsay.percentile(1.0)), (&[][..], HEARSAY));
        assert!(!played(|parties| killed_while_it_waits(parties, in_time + 1)).violations.is_empty());
    }

    #[test]
    fn arrival_stops_counting_once_all_know_the_loss() {
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
    fn killed_process_counts_for_one_generation_only() {
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
    fn killed_process_does_not_count_after_its_next_incarnation() {
        let verdict = played(|parties| {
            // The first of these incarnations was killed, and no party has counted it; the next one passes.
            parties[0][0].events.push(Event::Arrived(40));
            parties[0][0].killed = Some(50);
            parties[0].push(incarnation(&[Event::Started(60), Event::Arrived(70), Event::Passed(80, 2)]));
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
