//! Rules for the source files of this project, beyond those of the formatter and of clippy.
//!
//! Many readers learned English as a second language. They have to translate free relatives first (`who asks`,
//! `what was sent`), and persons in place of programs (`he`), so these are limited: CONTRIBUTING, section "Style".

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

/// Limit of `who` and its forms, for 1,000 words of a package's comments.
const WHO_MAX: usize = 1;
/// Limit of `what` and `whatever`, for 1,000 words of a package's comments.
const WHAT_MAX: usize = 3;
/// Maximum characters of a line with a comment. The formatter leaves comments alone.
const WIDTH_MAX: usize = 120;
/// Maximum lines of a source file: the parts of a longer one are files of their own.
const LINES_MAX: usize = 500;
/// Words of a test's name: enough for a claim, and few enough for a list of tests.
const NAME_WORDS: RangeInclusive<usize> = 3..=9;
/// Folders without sources of this project.
const SKIPPED: [&str; 4] = ["target", ".git", "corpus", "docs"];

/// Names in a private dialect that this code once had, and the field's term for each.
const BANNED: [(&str, &str); 50] = [
    ("Absences", "DownPolicies"),
    ("Acquaintance", "PeerState"),
    ("Aftermath", "NodeDownEvents"),
    ("Believed", "ServerTrust"),
    ("Burial", "PendingDrop"),
    ("Burials", "DropQueue"),
    ("ByDatagram", "DatagramShare"),
    ("Codename", "DataId"),
    ("Courtesy", "YieldPolicy"),
    ("Errand", "InFlightRequest"),
    ("Farewell", "HangUpAction"),
    ("Frill", "FrameOrigin::Link"),
    ("Greeting", "RegistrationHandshake"),
    ("HandedOn", "Forwarded"),
    ("Heirs", "SupervisorHandles"),
    ("InTurn", "ReorderBuffer"),
    ("LentMessage", "LoanedMessage"),
    ("LinkEnd", "PeerSocket"),
    ("NoDoor", "NoSocketError"),
    ("NoPlace", "LimitError"),
    ("Openers", "SocketAccess"),
    ("Outlet", "MessageSink"),
    ("Post", "EventQueue"),
    ("Posts", "EventQueues"),
    ("ProcessLife", "ProcessSupervision"),
    ("Roster", "SupervisorHandle"),
    ("Shelf", "ReceiveBacklog"),
    ("Strangers", "UnknownAddressLimits"),
    ("Tenant", "ActorHandle"),
    ("Unproven", "AuthError"),
    ("Untaken", "Undelivered"),
    ("Untold", "EventBacklog"),
    ("Vitals", "Liveness"),
    ("Voices", "RemoteViews"),
    ("ask_for_a_sign", "request_liveness"),
    ("bury", "push"),
    ("come_home", "reconnect_blocking"),
    ("connect_found", "connect_trusted"),
    ("give_way", "yield"),
    ("gives_a_sign", "mark_alive"),
    ("hear_the_rest", "drain"),
    ("is_bystander", "hosts_other_node"),
    ("is_one_of_a_flood", "is_burst"),
    ("is_patient", "is_delayable"),
    ("look_home", "ensure_connected"),
    ("poll_roused", "poll_delayed_wake"),
    ("reprieve", "deadline_extension"),
    ("rouse_later", "wake_later"),
    ("send_told", "send_with_tag"),
    ("while_away", "while_down"),
];

/// Types that implement `Error` and are none: a `Result` or a `Display` needs it. The glossary has them, too.
const NO_ERRORS: [(&str, &str); 3] = [
    ("Cause", "a state of an output, which is shown; `protection` of the runtime"),
    ("FirstDifference", "the result of a comparison of two runs"),
    ("Rejection", "the protocol's word for the reason of an outcome"),
];

const WHO: [&str; 5] = ["who", "whom", "whose", "whoever", "whomever"];
const WHAT: [&str; 2] = ["what", "whatever"];
const HE: [&str; 4] = ["he", "him", "his", "himself"];

/// A source file, and the path by which a message names it.
struct Source {
    path: PathBuf,
    text: String,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ is in the root")
}

fn sources() -> Vec<Source> {
    let (mut folders, mut found) = (vec![root().to_owned()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("the folder is readable") {
            let path = entry.expect("the folder is readable").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() && !SKIPPED.contains(&&*name) {
                folders.push(path);
            } else if name.ends_with(".rs") {
                let text = fs::read_to_string(&path).expect("a source is text");
                let path = path.strip_prefix(root()).expect("it is below the root").to_owned();
                found.push(Source { path, text });
            }
        }
    }
    assert!(found.len() > 500, "only {} sources were found: are the folders right?", found.len());
    found
}

/// Returns the folder of the package that has this file: the closest one with a manifest.
fn package(path: &Path) -> PathBuf {
    let has_manifest = |folder: &&Path| root().join(folder).join("Cargo.toml").is_file();
    path.ancestors().skip(1).find(has_manifest).unwrap_or_else(|| Path::new("")).to_owned()
}

/// Returns the text of a line's comment, if the line has nothing else.
fn comment(line: &str) -> Option<&str> {
    let text = line.trim_start().strip_prefix("//")?;
    Some(text.strip_prefix(['/', '!']).unwrap_or(text))
}

/// Returns the lower-case words of a comment, without code in backticks.
fn words(comment: &str) -> impl Iterator<Item = String> {
    let prose: String = comment.split('`').step_by(2).collect::<Vec<_>>().join(" ");
    let words: Vec<_> = prose
        .split(|character: char| !character.is_alphabetic() && character != '\'')
        .filter(|word| !word.is_empty())
        .map(str::to_lowercase)
        .collect();
    words.into_iter()
}

/// The counted words of one package, with the places of the limited ones.
#[derive(Default)]
struct Count {
    words: usize,
    places: [Vec<String>; 3],
}

fn count(sources: &[Source]) -> BTreeMap<PathBuf, Count> {
    let mut packages: BTreeMap<PathBuf, Count> = BTreeMap::new();
    for Source { path, text } in sources {
        let count = packages.entry(package(path)).or_default();
        for (line, text) in (1..).zip(text.lines()) {
            for word in comment(text).into_iter().flat_map(words) {
                count.words += 1;
                let lists = [&WHO[..], &WHAT[..], &HE[..]];
                for (list, places) in lists.into_iter().zip(&mut count.places) {
                    if list.contains(&&*word) {
                        places.push(format!("{}:{line}: {word}", path.display()));
                    }
                }
            }
        }
    }
    packages
}

#[test]
fn comments_use_few_free_relatives_and_no_persons() {
    for (package, Count { words, places: [who, what, he] }) in count(&sources()) {
        let thousands = words.div_ceil(1_000);
        for (places, max) in [(who, WHO_MAX * thousands), (what, WHAT_MAX * thousands), (he, 0)] {
            let (package, found) = (package.display(), places.len());
            assert!(
                found <= max,
                "{package}: {found} of {words} words, at most {max}:\n{}",
                places.join("\n")
            );
        }
    }
}

/// Returns the lines of a file whose comments are too wide. Tables, code and drawings keep the width that they need.
fn wide_lines(Source { path, text }: &Source) -> Vec<String> {
    let (mut is_code, mut wide) = (false, Vec::new());
    for (number, line) in (1..).zip(text.lines()) {
        let Some(comment) = comment(line) else {
            is_code = false;
            continue;
        };
        is_code ^= comment.trim_start().starts_with("```");
        let is_free = is_code || comment.starts_with(" |") || comment.starts_with("  ");
        if line.chars().count() > WIDTH_MAX && !is_free {
            wide.push(format!("{}:{number}", path.display()));
        }
    }
    wide
}

#[test]
fn comments_fit_the_width_of_the_code() {
    let wide: Vec<_> = sources().iter().flat_map(wide_lines).collect();
    assert!(wide.is_empty(), "wider than {WIDTH_MAX} characters:\n{}", wide.join("\n"));
}

#[test]
fn files_are_short() {
    let sources = sources();
    let long = sources.iter().map(|source| (source.text.lines().count(), source.path.display()));
    let long: Vec<_> = long.filter(|(lines, _)| *lines > LINES_MAX).collect();
    assert!(long.is_empty(), "longer than {LINES_MAX} lines: {long:?}");
}

/// Returns the uses of banned names in the code of a file.
fn banned_names(Source { path, text }: &Source) -> Vec<String> {
    let mut found = Vec::new();
    let is_word = |character: char| character.is_alphanumeric() || character == '_';
    let code = text.lines().map(|line| if comment(line).is_some() { "" } else { line });
    for (number, line) in (1..).zip(code) {
        for name in line.split(|character: char| !is_word(character)) {
            if let Some((name, term)) = BANNED.iter().find(|(banned, _)| *banned == name) {
                found.push(format!("{}:{number}: {name}: say {term}", path.display()));
            }
        }
    }
    found
}

#[test]
fn names_are_terms_of_the_field() {
    // The list itself has them all.
    let sources = sources().into_iter().filter(|source| !source.path.ends_with("tests/tidy.rs"));
    let found: Vec<_> = sources.flat_map(|source| banned_names(&source)).collect();
    assert!(found.is_empty(), "use the field's terms:\n{}", found.join("\n"));
}

/// Returns the types of a file that implement `Error` by a derive or by hand, without the comments' ones.
fn error_types(text: &str) -> Vec<String> {
    let code: Vec<_> = text.lines().filter(|line| comment(line).is_none()).collect();
    let code = code.join("\n");
    let mut found: Vec<_> = code.split("Error for ").skip(1).map(first_word).collect();
    for derived in code.split("#[derive(").skip(1) {
        let (traits, rest) = derived.split_once(")]").unwrap_or_default();
        if traits.split([',', ':']).any(|name| name.trim() == "Error") {
            found.extend(rest.lines().find_map(declared_type));
        }
    }
    found
}

/// Returns the name of the type that a line declares.
fn declared_type(line: &str) -> Option<String> {
    let is_visibility = |word: &&str| word.starts_with("pub") || word.ends_with(')');
    let mut words = line.split_whitespace().skip_while(is_visibility);
    let is_type = ["enum", "struct"].contains(&words.next()?);
    is_type.then(|| words.next().map(first_word)).flatten()
}

fn first_word(text: &str) -> String {
    text.chars().take_while(|character| character.is_alphanumeric() || *character == '_').collect()
}

#[test]
fn names_of_errors_end_in_error() {
    let mut excepted = BTreeSet::new();
    for Source { path, text } in sources().iter().filter(|source| !source.path.ends_with("tests/tidy.rs")) {
        for name in error_types(text).into_iter().filter(|name| !name.ends_with("Error")) {
            let reason = NO_ERRORS.iter().find(|(exception, _)| *exception == name);
            assert!(reason.is_some(), "{}: {name} is an error: let its name end in Error", path.display());
            excepted.insert(name);
        }
    }
    assert_eq!(excepted.len(), NO_ERRORS.len(), "an exception has gone: take it out of the list");
}

/// Returns the names of a file's tests, with their lines. A name that a macro receives is not in its text.
fn test_names(text: &str) -> Vec<(usize, String)> {
    let (mut is_test, mut names) = (false, Vec::new());
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim_start();
        is_test |= line.starts_with("#[test]") || line.starts_with("#[tokio::test");
        let mut words = line.split_whitespace();
        if is_test && !line.starts_with(['#', '/']) && words.any(|word| word == "fn") {
            names.extend(words.next().map(|name| (number, first_word(name))));
            is_test = false;
        }
    }
    names.retain(|(_, name)| !name.is_empty());
    names
}

/// Returns the tests of a file with names of too few or too many words.
fn unfit_test_names(Source { path, text }: &Source) -> Vec<String> {
    let names = test_names(text).into_iter();
    let unfit = names.filter(|(_, name)| !NAME_WORDS.contains(&name.split('_').count()));
    unfit.map(|(line, name)| format!("{}:{line}: {name}", path.display())).collect()
}

#[test]
fn names_of_tests_are_short_claims() {
    let sources = sources();
    let found: usize = sources.iter().map(|source| test_names(&source.text).len()).sum();
    assert!(found > 1_000, "only {found} tests were found: are the attributes right?");
    let unfit: Vec<_> = sources.iter().flat_map(unfit_test_names).collect();
    let (least, most) = (NAME_WORDS.start(), NAME_WORDS.end());
    assert!(unfit.is_empty(), "say the claim in {least} to {most} words:\n{}", unfit.join("\n"));
}

#[test]
fn rules_find_planted_violations() {
    let text = "/// Tells who asked.\nfn ask() {}\n// What he sent, and `whom` it names.\n";
    let wide = format!("//! {}\n//! | {}\n", "wide ".repeat(30), "table ".repeat(30));
    let planted = |text: &str| Source { path: PathBuf::from("tests/planted.rs"), text: text.to_owned() };
    let counted = count(&[planted(text)]).remove(Path::new("tests")).expect("the package of tests");
    assert_eq!(counted.places.map(|places| places.len()), [1, 1, 1]);
    assert_eq!(wide_lines(&planted(&wide)), ["tests/planted.rs:1"]);
    let named = banned_names(&planted("// a Roster\nlet x: Roster = is_rostered();\n"));
    assert_eq!(named, ["tests/planted.rs:2: Roster: say SupervisorHandle"]);
    let tests = [
        "#[test]\nfn it_works() {}\nfn helper() {}",
        "#[test]\n#[ignore = \"a fn of one\"]\nfn one_two_three() {}",
        "#[tokio::test]\nasync fn a_b_c_d_e_f_g_h_i_j() {}",
        "#[test]\nfn $claim() {}",
    ];
    let unfit = ["tests/planted.rs:2: it_works", "tests/planted.rs:8: a_b_c_d_e_f_g_h_i_j"];
    assert_eq!(unfit_test_names(&planted(&tests.join("\n"))), unfit);
    let derived = "#[derive(Debug, thiserror::Error)]\n#[error(\"a struct\")]\npub(crate) enum Trouble {\n";
    assert_eq!(error_types(derived), ["Trouble"]);
    assert_eq!(error_types("impl fmt::Error for One {}\n// impl Error for Two {}\n"), ["One"]);
    assert!(
        error_types("#[derive(Debug, Clone)]\nstruct Plain;\nimpl From<IoError> for Plain {}\n").is_empty()
    );
}
