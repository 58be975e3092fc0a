//! A small host: runs a compiled program scan by scan in virtual time.

use std::sync::OnceLock;

use dinrail_iec::artifact::{ElemType, Storage, Symbol, TrapId, sys};
use dinrail_iec::{Artifact, Options, Source, compile};
use wasmtime::{Config, Engine, Func, Instance, Linker, Memory, Module, Store};

/// A value of a variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    Int(i128),
    Real(f64),
}

impl From<bool> for Value {
    fn from(b: bool) -> Self {
        Self::Int(i128::from(b))
    }
}

/// A named fault of a program.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    pub id: TrapId,
    /// `file:line:column`
    pub place: String,
    pub statement: u32,
    pub instance: u32,
    pub value: i64,
    pub real: f64,
}

pub struct Host {
    pub store: Store<Vec<u32>>,
    instance: Instance,
    pub memory: Memory,
    pub artifact: Artifact,
    scan: u64,
}

pub fn engine() -> &'static Engine {
    static ENGINE: OnceLock<Engine> = OnceLock::new();
    ENGINE.get_or_init(|| {
        let mut config = Config::new();
        config.cranelift_nan_canonicalization(true);
        Engine::new(&config).unwrap()
    })
}

/// One source named `test.st`.
pub fn source(text: &str) -> Vec<Source> {
    vec![Source { name: "test.st".to_owned(), text: text.to_owned() }]
}

impl Host {
    pub fn new(text: &str) -> Self {
        Self::with(text, &Options::default())
    }

    pub fn with(text: &str, options: &Options) -> Self {
        Self::from_sources(&source(text), options)
    }

    pub fn from_sources(sources: &[Source], options: &Options) -> Self {
        let compiled = compile(sources, options).unwrap_or_else(|d| panic!("{}", d.render(false)));
        Self::load(compiled.artifact)
    }

    pub fn load(artifact: Artifact) -> Self {
        wasmparser::validate(&artifact.wasm).unwrap();
        let artifact = Artifact::from_wasm(&artifact.wasm).map(|a| {
            assert_eq!(a, artifact, "the artefact comes back from its bytes");
            a
        });
        let artifact = artifact.unwrap();
        let engine = engine();
        let module = Module::new(engine, &artifact.wasm).unwrap();
        let mut store = Store::new(engine, Vec::new());
        let mut linker: Linker<Vec<u32>> = Linker::new(engine);
        macro_rules! math {
            ($($name:literal $f:ident $f32:ident),*) => {$(
                linker.func_wrap("dinrail", $name, |x: f64| libm::$f(x)).unwrap();
                linker.func_wrap("dinrail", concat!($name, "f"), |x: f32| libm::$f32(x)).unwrap();
            )*};
        }
        math!("sin" sin sinf, "cos" cos cosf, "tan" tan tanf, "asin" asin asinf, "acos" acos acosf, "atan" atan atanf,
              "exp" exp expf, "ln" log logf, "log" log10 log10f);
        linker.func_wrap("dinrail", "expt", |x: f64, y: f64| libm::pow(x, y)).unwrap();
        linker.func_wrap("dinrail", "exptf", |x: f32, y: f32| libm::powf(x, y)).unwrap();
        linker
            .func_wrap("dinrail", "brk", |mut c: wasmtime::Caller<'_, Vec<u32>>, id: i32| {
                c.data_mut().push(id as u32);
            })
            .unwrap();
        let instance = linker.instantiate(&mut store, &module).unwrap();
        let memory = instance.get_memory(&mut store, "memory").unwrap();
        assert_eq!(memory.size(&store), u64::from(artifact.map.layout.pages));
        Self { store, instance, memory, artifact, scan: 0 }
    }

    pub fn task(&mut self, export: &str) -> Func {
        self.instance.get_func(&mut self.store, export).unwrap()
    }

    /// Runs all tasks once, by priority.
    pub fn scan_at(&mut self, t_ns: i64) -> Result<(), Fault> {
        self.scan += 1;
        self.write(sys::STAMP_NS, &t_ns.to_le_bytes());
        self.write(sys::SCAN, &self.scan.to_le_bytes());
        self.write(sys::FIRST_SCAN, &[u8::from(self.scan == 1)]);
        let mut tasks = self.artifact.map.tasks.clone();
        tasks.sort_by_key(|t| t.priority);
        for t in tasks {
            let f = self.task(&t.export).typed::<(), ()>(&self.store).unwrap();
            if let Err(e) = f.call(&mut self.store, ()) {
                return Err(self.fault().unwrap_or_else(|| panic!("trap without record: {e:?}")));
            }
        }
        Ok(())
    }

    /// A scan at time 0 that must not fault.
    pub fn run(&mut self) -> &mut Self {
        self.scan_at(0).unwrap();
        self
    }

    fn fault(&mut self) -> Option<Fault> {
        let id = TrapId::from_u32(self.u32(sys::TRAP_ID))?;
        let statement = self.u32(sys::TRAP_STATEMENT);
        Some(Fault {
            id,
            place: self.artifact.map.place_text(statement),
            statement,
            instance: self.u32(sys::TRAP_INSTANCE),
            value: i64::from_le_bytes(self.read(sys::TRAP_VALUE, 8).try_into().unwrap()),
            real: f64::from_le_bytes(self.read(sys::TRAP_REAL, 8).try_into().unwrap()),
        })
    }

    pub fn u32(&mut self, at: u32) -> u32 {
        u32::from_le_bytes(self.read(at, 4).try_into().unwrap())
    }

    pub fn read(&mut self, at: u32, bytes: usize) -> Vec<u8> {
        self.memory.data(&self.store)[at as usize..at as usize + bytes].to_vec()
    }

    pub fn write(&mut self, at: u32, bytes: &[u8]) {
        self.memory.data_mut(&mut self.store)[at as usize..at as usize + bytes.len()].copy_from_slice(bytes);
    }

    /// `path` or `path[3]` (first subscript of an array).
    fn symbol(&self, path: &str) -> (Symbol, u32) {
        let (name, index) = match path.strip_suffix(']').and_then(|p| p.rsplit_once('[')) {
            Some((n, i)) if self.artifact.map.symbol(path).is_none() => (n, Some(i.parse::<i64>().unwrap())),
            _ => (path, None),
        };
        let s = self.artifact.map.symbol(name).unwrap_or_else(|| panic!("no symbol {path}")).clone();
        let at = s.offset + index.map_or(0, |i| (i - s.dims[0].0) as u32 * s.elem.bytes());
        (s, at)
    }

    pub fn get(&mut self, path: &str) -> Value {
        let (s, at) = self.symbol(path);
        match s.storage {
            Storage::Bit(b) => return Value::Int(i128::from(self.read(at, 1)[0] >> b & 1)),
            Storage::Millis32 => return Value::Int(i128::from(self.u32(at) as i32) * 1_000_000),
            Storage::Plain => {}
        }
        let raw = self.read(at, s.elem.bytes() as usize);
        let mut wide = [0_u8; 8];
        wide[..raw.len()].copy_from_slice(&raw);
        let bits = u64::from_le_bytes(wide);
        use ElemType::*;
        match s.elem {
            Real => Value::Real(f64::from(f32::from_bits(bits as u32))),
            Lreal => Value::Real(f64::from_bits(bits)),
            Sint => Value::Int(i128::from(bits as i8)),
            Int => Value::Int(i128::from(bits as i16)),
            Dint => Value::Int(i128::from(bits as i32)),
            Lint | Time => Value::Int(i128::from(bits as i64)),
            _ => Value::Int(i128::from(bits)),
        }
    }

    pub fn int(&mut self, path: &str) -> i128 {
        match self.get(path) {
            Value::Int(v) => v,
            Value::Real(v) => panic!("{path} is real: {v}"),
        }
    }

    pub fn real(&mut self, path: &str) -> f64 {
        match self.get(path) {
            Value::Real(v) => v,
            Value::Int(v) => panic!("{path} is no real: {v}"),
        }
    }

    pub fn set(&mut self, path: &str, value: Value) {
        let (s, at) = self.symbol(path);
        match (s.storage, value) {
            (Storage::Bit(b), Value::Int(v)) => {
                let old = self.read(at, 1)[0];
                self.write(at, &[old & !(1 << b) | ((v as u8 & 1) << b)]);
            }
            (Storage::Millis32, Value::Int(v)) => self.write(at, &((v / 1_000_000) as i32).to_le_bytes()),
            (_, Value::Int(v)) if !matches!(s.elem, ElemType::Real | ElemType::Lreal) => {
                self.write(at, &(v as i64).to_le_bytes()[..s.elem.bytes() as usize]);
            }
            (_, v) => {
                let v = match v {
                    Value::Int(v) => v as f64,
                    Value::Real(v) => v,
                };
                if s.elem == ElemType::Real {
                    self.write(at, &(v as f32).to_le_bytes());
                } else {
                    self.write(at, &v.to_le_bytes());
                }
            }
        }
    }
}
