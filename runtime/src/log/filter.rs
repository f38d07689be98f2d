//! The filter of events for the default log. Pure.

use tracing::{Level, level_filters::LevelFilter};

/// The prefix of the names of Sinew's crates.
const OWN: &str = "sinew";

/// The parsed directives of `SINEW_LOG`: `warn`, `info,sinew::gncl=debug`, `off`. The syntax is that of `EnvFilter` of
/// `tracing-subscriber`, without spans and fields, which do not occur here.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Filter {
    /// Prefixes of targets, the longest first, with the maximum level of each.
    targets: Vec<(String, LevelFilter)>,
    /// The maximum level of all other targets.
    rest: LevelFilter,
}

impl Filter {
    /// Parses directives. Invalid ones are ignored. If none is about Sinew, all events up to `usual` pass:
    /// `RUST_LOG` may be set only for other parts of the program.
    pub(super) fn read(setting: &str, usual: LevelFilter) -> Self {
        let (mut targets, mut rest) = (Vec::new(), None);
        for directive in setting.split(',').map(str::trim).filter(|directive| !directive.is_empty()) {
            match directive.split_once('=') {
                Some((target, level)) => {
                    // `sinew[span{field}]=info` is about spans.
                    if let (Ok(level), false) = (level.trim().parse(), target.contains('[')) {
                        targets.push((target.trim().to_owned(), level));
                    }
                }
                None => match directive.parse() {
                    Ok(level) => rest = Some(level),
                    Err(_) => targets.push((directive.to_owned(), LevelFilter::TRACE)),
                },
            }
        }
        let is_ours = |target: &str| target.starts_with(OWN) || OWN.starts_with(target);
        let is_about_us = targets.iter().any(|(target, _)| is_ours(target));
        // As with `EnvFilter`: if targets are named, only those pass.
        let others = if is_about_us { LevelFilter::OFF } else { usual };
        targets.sort_by_key(|(target, _)| std::cmp::Reverse(target.len()));
        Self { targets, rest: rest.unwrap_or(others) }
    }

    /// Returns whether an event of this level from `target` is written.
    pub(super) fn wants(&self, target: &str, level: Level) -> bool {
        let known = self.targets.iter().find(|(start, _)| target.starts_with(start));
        target.starts_with(OWN) && level <= known.map_or(self.rest, |(_, most)| *most)
    }

    /// Returns the maximum level that is written for any target.
    pub(super) fn most(&self) -> LevelFilter {
        self.targets.iter().map(|(_, most)| *most).fold(self.rest, LevelFilter::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lowest levels that are written for GNCL, NDL, and the runtime.
    fn levels(setting: &str) -> [LevelFilter; 3] {
        let filter = Filter::read(setting, LevelFilter::INFO);
        ["sinew::gncl::actor", "sinew::ndl", "sinew_runtime::app"].map(|target| {
            let levels = [Level::TRACE, Level::DEBUG, Level::INFO, Level::WARN, Level::ERROR];
            let most = levels.into_iter().find(|level| filter.wants(target, *level));
            most.map_or(LevelFilter::OFF, LevelFilter::from_level)
        })
    }

    #[test]
    fn level_applies_to_all_and_longer_targets_first() {
        use LevelFilter as L;
        for (setting, wanted) in [
            ("warn", [L::WARN; 3]),
            ("OFF", [L::OFF; 3]),
            ("warn,sinew::gncl=debug", [L::DEBUG, L::WARN, L::WARN]),
            (" sinew=error , sinew::gncl=trace ", [L::TRACE, L::ERROR, L::ERROR]),
            ("sinew::gncl=debug", [L::DEBUG, L::OFF, L::OFF]),
            ("sinew::gncl", [L::TRACE, L::OFF, L::OFF]),
            // No directive for Sinew, or none that is valid.
            ("my_robot=debug", [L::INFO; 3]),
            ("sinew[span]=debug,sinew=verbose,,", [L::INFO; 3]),
            ("my_robot=debug,error", [L::ERROR; 3]),
        ] {
            assert_eq!(levels(setting), wanted, "{setting}");
        }
    }

    #[test]
    fn events_of_other_crates_are_not_written() {
        assert!(!Filter::read("trace", LevelFilter::INFO).wants("my_robot", Level::ERROR));
        assert_eq!(Filter::read("warn,sinew::gncl=debug", LevelFilter::INFO).most(), LevelFilter::DEBUG);
    }
}
