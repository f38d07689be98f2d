//! Parameters that a program in Python serves.

use std::{
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use pyo3::{IntoPyObjectExt as _, exceptions::PyValueError, prelude::*};
use sinew_client::{ApiError, AsyncEndpoint, EndpointParameters};
use sinew_runtime::parameters::{Cell, Descriptor, Domain, PARAMETERS_MAX, Param, Parameters, Value};

/// Maximum number of declared parameters of one process. A declaration lives as long as the process, as that of a type
/// in Rust, so that a program cannot declare new ones in a loop.
const DECLARED_MAX: usize = 4_096;
static DECLARED: AtomicUsize = AtomicUsize::new(0);

/// A parameter as Python declares it: name, description, unit, default, range, slope in a second.
type Declaration = (String, String, String, AnyValue, Option<(AnyValue, AnyValue)>, Option<f64>);

/// A value of a parameter. A flag is a number in Python, too, and so comes first.
#[derive(Clone, Copy, FromPyObject)]
pub(crate) enum AnyValue {
    Flag(bool),
    Integer(i64),
    Number(f64),
}

impl From<AnyValue> for Value {
    fn from(value: AnyValue) -> Self {
        match value {
            AnyValue::Flag(flag) => Self::Flag(flag),
            AnyValue::Integer(integer) => Self::Integer(integer),
            AnyValue::Number(number) => Self::Number(number),
        }
    }
}

/// The declarations of the parameters of one class.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct ParameterDeclarations(&'static [Descriptor]);

#[pymethods]
impl ParameterDeclarations {
    #[new]
    fn new(declarations: Vec<Declaration>) -> PyResult<Self> {
        let count = declarations.len();
        if count > PARAMETERS_MAX {
            let text =
                format!("the class declares {count} parameters: an application has at most {PARAMETERS_MAX}");
            return Err(PyValueError::new_err(text));
        }
        // SYNC: Relaxed; the count alone matters.
        if DECLARED.fetch_add(count, Ordering::Relaxed) + count > DECLARED_MAX {
            DECLARED.fetch_sub(count, Ordering::Relaxed);
            let text = format!(
                "this process has declared {DECLARED_MAX} parameters: declare each class once, at the top of its module"
            );
            return Err(PyValueError::new_err(text));
        }
        let descriptors = declarations.into_iter().map(descriptor).collect::<PyResult<Vec<_>>>()?;
        Ok(Self(descriptors.leak()))
    }
}

fn descriptor((name, description, unit, default, range, slope): Declaration) -> PyResult<Descriptor> {
    let domain = match (default, range) {
        (AnyValue::Flag(default), None) => Domain::Flag { default },
        (AnyValue::Integer(default), Some((AnyValue::Integer(min), AnyValue::Integer(max)))) => {
            Domain::Integer { default, min, max }
        }
        (AnyValue::Number(default), Some((AnyValue::Number(min), AnyValue::Number(max)))) => {
            Domain::Number { default, min, max, slope_per_s: slope }
        }
        _ => return Err(PyValueError::new_err(format!("{name}: the range has the type of the default"))),
    };
    let [name, description, unit] = [name, description, unit].map(|text| &*text.leak());
    let descriptor = Descriptor { name, description, unit, domain, keep: false };
    match descriptor.fault() {
        Some(why) => Err(PyValueError::new_err(format!("{name}: {why}"))),
        None => Ok(descriptor),
    }
}

/// The values of the parameters of one endpoint.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct ParameterSet(Arc<Values>);

struct Values {
    descriptors: &'static [Descriptor],
    params: Vec<AnyParam>,
}

enum AnyParam {
    Number(Param<f64>),
    Integer(Param<i64>),
    Flag(Param<bool>),
}

impl Parameters for Values {
    fn descriptors(&self) -> &'static [Descriptor] {
        self.descriptors
    }

    fn cell(&self, index: usize) -> Option<&Cell> {
        self.params.get(index).map(|param| match param {
            AnyParam::Number(param) => param.cell(),
            AnyParam::Integer(param) => param.cell(),
            AnyParam::Flag(param) => param.cell(),
        })
    }
}

#[pymethods]
impl ParameterSet {
    #[new]
    fn new(declarations: &ParameterDeclarations) -> Self {
        let descriptors = declarations.0;
        let params = descriptors.iter().map(|descriptor| match descriptor.domain {
            Domain::Number { default, .. } => AnyParam::Number(Param::new(default)),
            Domain::Integer { default, .. } => AnyParam::Integer(Param::new(default)),
            Domain::Flag { default } => AnyParam::Flag(Param::new(default)),
        });
        Self(Arc::new(Values { descriptors, params: params.collect() }))
    }

    /// Returns the current value of the parameter with this index.
    fn get(&self, py: Python<'_>, index: usize) -> PyResult<Py<PyAny>> {
        match self.0.params.get(index) {
            Some(AnyParam::Number(param)) => param.get().into_py_any(py),
            Some(AnyParam::Integer(param)) => param.get().into_py_any(py),
            Some(AnyParam::Flag(param)) => param.get().into_py_any(py),
            None => Err(PyValueError::new_err(format!("no parameter has the index {index}"))),
        }
    }
}

/// Parameters for a registration, and the period of the loop that reads them; zero: there is no loop.
pub(crate) struct ToServe {
    values: Arc<Values>,
    period: Duration,
}

impl ToServe {
    pub(crate) fn new(set: &ParameterSet, period: Duration) -> Self {
        Self { values: Arc::clone(&set.0), period }
    }
}

/// An endpoint with the parameters that it serves.
pub(crate) struct Registered {
    pub(crate) endpoint: AsyncEndpoint,
    parameters: Option<EndpointParameters>,
}

impl Registered {
    pub(crate) fn new(mut endpoint: AsyncEndpoint, parameters: Option<&ToServe>) -> Self {
        let parameters =
            parameters.map(|of| EndpointParameters::new_async(&mut endpoint, &of.values, of.period));
        Self { endpoint, parameters }
    }

    /// Waits for a message that is not about parameters.
    pub(crate) async fn receive(&mut self) -> Result<sinew_client::Received, ApiError> {
        loop {
            let received = self.endpoint.receive().await?;
            let Some(parameters) = &mut self.parameters else { return Ok(received) };
            if let Some(other) = parameters.serve_async(&mut self.endpoint, received).await {
                return Ok(other);
            }
        }
    }

    /// Begins a turn of the loop: sets that wait are applied.
    pub(crate) async fn tick(&mut self) {
        if let Some(parameters) = &mut self.parameters {
            parameters.tick_async(&mut self.endpoint).await;
        }
    }
}
