//! Rules for the layout: the packages and their directions, and the folders within a package.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;

/// The layers. None of them may stand on another one.
const LAYERS: [&str; 4] = ["sinew-lncl", "sinew-gncl", "sinew-ndl", "sinew-sync"];
/// The only package that stands on all layers. (`sinew` names some for its reports and for fuzzers.)
const NODE: &str = "sinew-node";
/// Its examples stand on a package above it, so nothing runs them.
const WITH_EXAMPLES_NOT_RUN: &str = "sinew-ndl";
/// The line of docs/ARCHITECTURE.md above the picture of the packages.
const MARKER: &str = "<!-- packages:";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ is in the root")
}

/// Returns cargo's description of each package of this workspace.
fn metadata() -> Vec<Value> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(root())
        .output()
        .expect("cargo runs");
    let mut metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo writes JSON");
    let Value::Array(packages) = metadata["packages"].take() else { panic!("no list of packages") };
    packages
}

/// Returns the packages of this workspace, and the others of them that each needs outside of tests.
fn packages() -> BTreeMap<String, BTreeSet<String>> {
    let all = metadata();
    let name = |of: &Value| of["name"].as_str().expect("it has a name").to_owned();
    let own: BTreeSet<_> = all.iter().map(name).collect();
    let needs = |package: &Value| {
        let all = package["dependencies"].as_array().expect("a list of dependencies").iter();
        let normal = all.filter(|needed| needed["kind"].is_null() && needed["optional"] != true);
        normal.map(name).filter(|needed| own.contains(needed)).collect()
    };
    all.iter().map(|package| (name(package), needs(package))).collect()
}

/// Returns everything that a package stands on.
fn below(packages: &BTreeMap<String, BTreeSet<String>>, package: &str) -> BTreeSet<String> {
    let (mut open, mut found) = (vec![package.to_owned()], BTreeSet::new());
    while let Some(next) = open.pop() {
        let needs = packages.get(&next).into_iter().flatten();
        open.extend(needs.filter(|needed| found.insert((*needed).clone())).cloned());
    }
    found
}

#[test]
fn no_layer_stands_on_another_one() {
    let packages = packages();
    for layer in LAYERS {
        let below = below(&packages, layer);
        assert!(!below.contains(NODE), "{layer} stands on {NODE}");
        for other in LAYERS {
            assert!(!below.contains(other), "{layer} stands on {other}");
        }
    }
    assert!(LAYERS.iter().all(|layer| packages[NODE].contains(*layer)), "{NODE} names all layers");
}

#[test]
fn client_and_bindings_stand_on_no_layer() {
    let packages = packages();
    for package in ["sinew-client", "sinew-c", "sinew-python"] {
        let below = below(&packages, package);
        let unwanted = LAYERS.into_iter().chain([NODE, "sinew", "sinew-security", "sinew-session"]);
        for other in unwanted {
            assert!(!below.contains(other), "{package} stands on {other}");
        }
    }
}

#[test]
fn picture_of_the_packages_is_true() {
    let page = fs::read_to_string(root().join("docs/ARCHITECTURE.md")).expect("the page is there");
    let (_, rest) = page.split_once(MARKER).expect("the page has the marker");
    let block = rest.split("```").nth(1).expect("a block follows");
    let packages = packages();
    let mut shown = BTreeSet::new();
    for line in block.lines().filter(|line| line.contains("->")) {
        let (name, needs) = line.split_once("->").expect("it has an arrow");
        let name = name.trim();
        let needs: BTreeSet<_> = needs.split_whitespace().map(str::to_owned).collect();
        assert_eq!(packages.get(name), Some(&needs), "docs/ARCHITECTURE.md, line of {name}");
        for needed in &needs {
            assert!(shown.contains(needed), "docs/ARCHITECTURE.md: {name} stands above {needed}");
        }
        shown.insert(name.to_owned());
    }
    for package in below(&packages, "sinew").iter().map(String::as_str).chain([
        "sinew",
        "sinew-c",
        "sinew-cli",
        "sinew-python",
    ]) {
        assert!(shown.contains(package), "docs/ARCHITECTURE.md does not show {package}");
    }
}

/// Returns the faults of one dependency of a published package.
fn unpublishable(needed: &Value, published: &BTreeMap<String, String>) -> Option<String> {
    let name = needed["name"].as_str().expect("it has a name");
    // A dependency from elsewhere has no path.
    needed["path"].as_str()?;
    let asked = needed["req"].as_str().expect("it has a version or a star");
    if needed["kind"] == "dev" {
        let is_left_out = asked == "*";
        return (!is_left_out)
            .then(|| format!("names {name} with a version in its tests: write its path alone"));
    }
    match published.get(name) {
        None => Some(format!("stands on {name}, which is not published")),
        Some(version) if asked == format!("^{version}") => None,
        Some(version) => Some(format!("asks for {name} {asked}, and the workspace has {version}")),
    }
}

#[test]
fn published_packages_are_complete() {
    let all = metadata();
    let text = |of: &Value, key: &str| of[key].as_str().unwrap_or_default().to_owned();
    let (open, own): (Vec<_>, Vec<_>) = all.iter().partition(|package| package["publish"].is_null());
    let published: BTreeMap<_, _> =
        open.iter().map(|package| (text(package, "name"), text(package, "version"))).collect();
    assert!(published.contains_key("sinew") && published.contains_key("sinew-cli"), "{published:?}");
    for package in open {
        let name = text(package, "name");
        for key in ["description", "license", "readme", "rust_version"] {
            assert!(!text(package, key).is_empty(), "{name} has no {key}");
        }
        for key in ["keywords", "categories"] {
            assert!(package[key].as_array().is_some_and(|words| !words.is_empty()), "{name} has no {key}");
        }
        let folder = PathBuf::from(text(package, "manifest_path"));
        for licence in ["LICENSE-MIT", "LICENSE-APACHE"] {
            assert!(folder.with_file_name(licence).is_file(), "{name} has no {licence}");
        }
        let needs = package["dependencies"].as_array().expect("a list of dependencies");
        let faults: Vec<_> = needs.iter().filter_map(|needed| unpublishable(needed, &published)).collect();
        assert!(faults.is_empty(), "{name} {}", faults.join("; it "));
    }
    for package in own {
        let path = text(package, "manifest_path");
        let inside = Path::new(&path).strip_prefix(root()).expect("it is in the workspace");
        let is_inner = ["tests", "benches", "examples", "bindings"].iter().any(|top| inside.starts_with(top));
        assert!(is_inner, "{path}: say `publish = true`, or move it to the tests, benches or examples");
    }
}

/// Returns the folders of all crates with a folder of their own: libraries, programs, tests and benches.
fn crate_folders() -> BTreeSet<PathBuf> {
    let mut folders = BTreeSet::new();
    for package in metadata() {
        for target in package["targets"].as_array().expect("a list of targets") {
            let source = Path::new(target["src_path"].as_str().expect("it has a source"));
            if source.ends_with("lib.rs") || source.ends_with("main.rs") {
                folders.extend(source.parent().map(Path::to_owned));
            }
        }
    }
    folders
}

/// Returns the sources of a crate, without unit tests.
fn sources(crate_folder: &Path) -> Vec<PathBuf> {
    let (mut folders, mut found) = (vec![crate_folder.to_owned()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("the folder is readable") {
            let path = entry.expect("the folder is readable").path();
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let is_test = name.ends_with("tests") || ["testing", "model"].contains(&&*name);
            if path.is_dir() && !is_test {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") && !is_test {
                found.push(path);
            }
        }
    }
    found
}

/// Returns the folders of a crate, at every depth, each with those beside it that it imports.
fn imports(crate_folder: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let (mut files, mut folders) = (Vec::new(), BTreeSet::new());
    for file in sources(crate_folder) {
        let path = file.strip_prefix(crate_folder).expect("it is in the folder");
        let parents = path.ancestors().skip(1).filter(|parent| *parent != Path::new(""));
        folders.extend(parents.map(module));
        files.push((module(path), fs::read_to_string(&file).expect("a source is text")));
    }
    let mut arrows: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (module, text) in files {
        for named in named(&text, &module) {
            let shared = module.iter().zip(&named).take_while(|(one, other)| one == other).count();
            let (Some(from), Some(to)) = (module.get(..=shared), named.get(..=shared)) else { continue };
            if folders.contains(from) && folders.contains(to) {
                arrows.entry(from.join("::")).or_default().insert(to.join("::"));
            }
        }
    }
    arrows
}

/// Returns the module that a folder or a source of a crate is, by the names from the top.
fn module(path: &Path) -> Vec<String> {
    let path = if path.ends_with("mod.rs") { path.parent().unwrap_or(path) } else { path };
    let path = path.with_extension("");
    path.iter().map(|name| name.to_string_lossy().into_owned()).collect()
}

/// Returns the items that the file of a module names outside of its unit tests, by `crate::` or by `super::`, each by
/// its names from the top of the crate.
fn named(text: &str, module: &[String]) -> Vec<Vec<String>> {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    let code = lines.collect::<Vec<_>>().join("\n");
    let from_the_top = code.split("crate::").skip(1).map(|rest| (0, rest));
    let supers = code.match_indices("super::").filter(|(at, _)| !code[..*at].ends_with("super::"));
    let from_here = supers.filter_map(|(at, _)| {
        let rest = code[at..].trim_start_matches("super::");
        let above = (code[at..].len() - rest.len()) / "super::".len();
        Some((module.len().checked_sub(above)?, rest))
    });
    from_the_top
        .chain(from_here)
        .flat_map(|(kept, rest)| paths(rest).into_iter().map(move |path| [&module[..kept], &path].concat()))
        .collect()
}

/// Returns the paths at the start of a text: `one::two` is one, and `one::{two, three::four}` are two.
fn paths(text: &str) -> Vec<Vec<String>> {
    if let Some(group) = text.strip_prefix('{') {
        return members(group).into_iter().flat_map(paths).collect();
    }
    let is_letter = |letter: char| letter.is_alphanumeric() || letter == '_';
    let rest = text.trim_start_matches(is_letter);
    let name = text[..text.len() - rest.len()].to_owned();
    match rest.strip_prefix("::") {
        Some(rest) => paths(rest).into_iter().map(|path| [vec![name.clone()], path].concat()).collect(),
        None => vec![vec![name]],
    }
}

/// Returns the members of an import's group, which follows the opening brace.
fn members(group: &str) -> Vec<&str> {
    let (mut depth, mut start, mut found) = (0_usize, 0, Vec::new());
    for (at, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' if depth == 0 => {
                found.push(group[start..at].trim_start());
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                found.push(group[start..at].trim_start());
                start = at + 1;
            }
            _ => {}
        }
    }
    found
}

/// Returns a circle of imports, if there is one.
fn circle(arrows: &BTreeMap<String, BTreeSet<String>>) -> Option<(String, String)> {
    let pairs = arrows.iter().flat_map(|(from, to)| to.iter().map(move |to| (from, to)));
    let mut circles = pairs.filter(|(from, to)| below(arrows, to).contains(*from));
    circles.next().map(|(from, to)| (from.clone(), to.clone()))
}

#[test]
fn sibling_folders_import_in_one_direction() {
    let folders = crate_folders();
    for nested in ["bag/recorder/src", "tests/robot/src", "benches/charts/src", "actors/ndl/tests/simulation"]
    {
        assert!(folders.contains(&root().join(nested)), "{nested} is not among the folders of crates");
    }
    for folder in folders {
        if let Some((one, other)) = circle(&imports(&folder)) {
            let folder = folder.display();
            panic!("{folder}: {one} and {other} import each other, directly or by others");
        }
    }
}

/// Returns the sources of a library or a program, without unit tests. A program beside a library is one file.
fn sources_of(target: &Value) -> Vec<PathBuf> {
    let source = Path::new(target["src_path"].as_str().expect("it has a source"));
    let folder = source.parent().expect("a file is in a folder");
    let is_alone = source.ends_with("main.rs") && !folder.join("lib.rs").exists();
    if is_alone || source.ends_with("lib.rs") { sources(folder) } else { vec![source.to_owned()] }
}

/// Returns whether a source has a block of Rust in its documentation.
fn has_example(text: &str) -> bool {
    let lines = text.lines().map(str::trim_start);
    let docs = lines.filter_map(|line| line.strip_prefix("///").or_else(|| line.strip_prefix("//!")));
    let fences = docs.filter_map(|line| line.trim_start().strip_prefix("```"));
    // Every second one ends a block.
    fences.step_by(2).any(|language| language != "text")
}

#[test]
fn code_excluded_from_tests_has_no_tests() {
    let mut excluded = 0;
    for package in metadata() {
        for target in package["targets"].as_array().expect("a list of targets") {
            let kinds = target["kind"].as_array().expect("a list of kinds");
            let is_library = kinds.iter().any(|kind| kind == "lib" || kind == "rlib");
            let has_no_tests = (is_library || kinds[0] == "bin") && target["test"] == false;
            let has_no_examples =
                is_library && target["doctest"] == false && package["name"] != WITH_EXAMPLES_NOT_RUN;
            if !has_no_tests && !has_no_examples {
                continue;
            }
            excluded += 1;
            for source in sources_of(target) {
                let text = fs::read_to_string(&source).expect("a source is text");
                let source = source.display();
                let is_tested = has_no_tests && (text.contains("#[cfg(test)]") || text.contains("#[test]"));
                assert!(
                    !is_tested,
                    "{source}: nothing runs these tests; remove `test = false` in Cargo.toml"
                );
                let is_shown = has_no_examples && has_example(&text);
                assert!(
                    !is_shown,
                    "{source}: nothing runs this example; remove `doctest = false` in Cargo.toml"
                );
            }
        }
    }
    assert!(excluded > 0, "cargo describes no target that is excluded");
    assert!(has_example("/// ```text\n/// 1\n/// ```\n/// ```no_run\n/// let a = 1;\n/// ```"));
    assert!(!has_example("//! ```text\n//! 1\n//! ```"));
}

#[test]
fn rules_find_planted_circles() {
    assert_eq!(members("one::Thing, two::{A, B}, three}; more, of"), ["one::Thing", "two::{A, B}", "three"]);
    let text = "use crate::{one::A, two};\nuse super::super::three::B;\n// crate::four\nuse super::{five};\n";
    let named: Vec<_> =
        named(text, &module(Path::new("six/seven.rs"))).iter().map(|path| path.join("::")).collect();
    assert_eq!(named, ["one::A", "two", "three::B", "six::five"]);
    assert_eq!(module(Path::new("six/seven/mod.rs")), ["six", "seven"]);
    let arrow = |from: &str, to: &str| (from.to_owned(), BTreeSet::from([to.to_owned()]));
    let straight = BTreeMap::from([arrow("one", "two"), arrow("two", "three")]);
    assert_eq!(circle(&straight), None);
    let bent = BTreeMap::from([arrow("one", "two"), arrow("two", "three"), arrow("three", "one")]);
    assert_eq!(
        circle(&bent),
        Some(("one".to_owned(), "three".to_owned())).map(|_| ("one".to_owned(), "two".to_owned()))
    );
}
