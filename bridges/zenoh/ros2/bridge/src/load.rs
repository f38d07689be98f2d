//! The mapping file, and the definitions of messages beside it.

use std::{
    fmt, fs,
    io::Read as _,
    path::{Path, PathBuf},
};

use sinew_ros2_core::{
    Catalog, Service,
    mapping::{FILE_BYTES_MAX, Mapping, MappingFile},
};

/// Maximum number of files in the folder with definitions.
const DEFINITIONS_MAX: usize = 512;
/// Maximum bytes of each of them.
const DEFINITION_BYTES_MAX: usize = 65_536;

/// A mapping, with all types that it needs.
#[derive(Debug)]
pub struct Loaded {
    /// The mapping.
    pub mapping: Mapping,
    /// The services that the bridge offers.
    pub(crate) services: Services,
    /// The definitions.
    pub(crate) catalog: Catalog,
}

/// The types of services.
#[derive(Clone, Debug)]
pub(crate) struct Services {
    pub(crate) trigger: Service,
    pub(crate) list: Service,
    pub(crate) describe: Service,
    pub(crate) get: Service,
    pub(crate) types: Service,
    pub(crate) set: Service,
    pub(crate) set_all: Service,
}

/// The faults of a mapping file, all of them.
#[derive(Debug)]
pub struct LoadError {
    path: PathBuf,
    faults: Vec<String>,
}

impl fmt::Display for LoadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.faults.join("; "))
    }
}

impl std::error::Error for LoadError {}

/// Reads and checks a mapping file. A relative path of the folder with definitions starts at the file's own folder.
///
/// # Errors
/// All faults, each with its place and the remedy.
pub fn load(path: &Path) -> Result<Loaded, LoadError> {
    let refused = |faults| LoadError { path: path.to_owned(), faults };
    let one = |fault| refused(vec![fault]);
    let file = MappingFile::parse(&read(path, FILE_BYTES_MAX).map_err(one)?).map_err(one)?;
    let mut catalog = Catalog::shipped();
    if let Some(folder) = file.messages() {
        let folder = path.parent().unwrap_or_else(|| Path::new(".")).join(folder);
        add_folder(&mut catalog, &folder).map_err(one)?;
    }
    let services = Services::of(&catalog).map_err(one)?;
    let mapping = file.check(&catalog).map_err(refused)?;
    Ok(Loaded { mapping, services, catalog })
}

impl Services {
    fn of(catalog: &Catalog) -> Result<Self, String> {
        let service = |name: &str| catalog.service(name).map_err(|why| why.to_string());
        Ok(Self {
            trigger: service("std_srvs/srv/Trigger")?,
            list: service("rcl_interfaces/srv/ListParameters")?,
            describe: service("rcl_interfaces/srv/DescribeParameters")?,
            get: service("rcl_interfaces/srv/GetParameters")?,
            types: service("rcl_interfaces/srv/GetParameterTypes")?,
            set: service("rcl_interfaces/srv/SetParameters")?,
            set_all: service("rcl_interfaces/srv/SetParametersAtomically")?,
        })
    }
}

/// Adds the files `PACKAGE/msg/NAME.msg` and `PACKAGE/srv/NAME.srv` of a folder, as `share` of a ROS installation has
/// them.
fn add_folder(catalog: &mut Catalog, folder: &Path) -> Result<(), String> {
    let mut count = 0;
    for package in entries(folder)? {
        for kind in ["msg", "srv"] {
            let inner = package.join(kind);
            if !inner.is_dir() {
                continue;
            }
            for file in entries(&inner)? {
                if file.extension().is_none_or(|extension| extension != kind) {
                    continue;
                }
                count += 1;
                if count > DEFINITIONS_MAX {
                    let shown = folder.display();
                    return Err(format!(
                        "messages: {shown} has more than {DEFINITIONS_MAX} definitions; copy those that are used"
                    ));
                }
                let name = name_of(&package, kind, &file)?;
                catalog
                    .add(&name, &read(&file, DEFINITION_BYTES_MAX)?)
                    .map_err(|why| format!("messages: {why}"))?;
            }
        }
    }
    Ok(())
}

fn name_of(package: &Path, kind: &str, file: &Path) -> Result<String, String> {
    let parts = [package.file_name(), file.file_stem()].map(|part| part.and_then(|part| part.to_str()));
    let [Some(package), Some(name)] = parts else {
        return Err(format!("messages: {} has a name that is no text", file.display()));
    };
    Ok(format!("{package}/{kind}/{name}"))
}

/// Returns the entries of a folder in the order of their names.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let fault = |why: std::io::Error| format!("messages: {}: {why}", folder.display());
    let entries = fs::read_dir(folder).map_err(fault)?.take(DEFINITIONS_MAX + 1);
    let mut paths =
        entries.map(|entry| Ok(entry.map_err(fault)?.path())).collect::<Result<Vec<_>, String>>()?;
    paths.sort();
    Ok(paths)
}

/// Reads a text of bounded length.
fn read(path: &Path, bytes_max: usize) -> Result<String, String> {
    let fault = |why: std::io::Error| format!("{}: {why}", path.display());
    let mut text = String::new();
    let file = fs::File::open(path).map_err(fault)?;
    file.take(bytes_max as u64 + 1).read_to_string(&mut text).map_err(fault)?;
    if text.len() > bytes_max {
        return Err(format!("{}: it has more than {bytes_max} bytes", path.display()));
    }
    Ok(text)
}
