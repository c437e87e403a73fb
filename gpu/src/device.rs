//! Adapters of the machine, and a connection to one of them.

use std::sync::{Mutex, PoisonError};

use cubecl::client::Client;
use cubecl::ir::{ElemType, FloatKind};
use cubecl::wgpu::{AutoGraphicsApi, RuntimeOptions, WgpuBackend, WgpuDevice, WgpuDeviceKind};

use crate::error::GpuError;

/// Kind of an adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum AdapterKind {
    /// GPU with its own memory.
    Discrete,
    /// GPU that shares the memory of the CPU.
    Integrated,
    /// GPU of a virtual machine.
    Virtual,
    /// Unknown.
    Other,
    /// Software on the CPU, such as Mesa's lavapipe.
    Cpu,
}

impl std::fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Discrete => "discrete GPU",
            Self::Integrated => "integrated GPU",
            Self::Virtual => "virtual GPU",
            Self::Other => "unknown kind",
            Self::Cpu => "software on the CPU",
        })
    }
}

/// GPU, or software that implements the interface of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Adapter {
    /// Name of the device.
    pub name: String,
    /// Kind of the device.
    pub kind: AdapterKind,
    /// Programming interface: Vulkan, Metal.
    pub api: String,
    /// Name and version of the driver.
    pub driver: String,
    /// True if the device computes in double precision.
    pub double: bool,
    /// Largest buffer, bytes.
    pub max_buffer: u64,
    /// Identifier of the device in the runtime.
    device: WgpuDevice,
}

impl std::fmt::Display for Adapter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let precision = if self.double { "single and double precision" } else { "single precision" };
        let Self { name, kind, api, driver, .. } = self;
        write!(f, "{name} ({kind}, {api}, {driver}, {precision})")
    }
}

#[cfg(feature = "vulkan")]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::VULKAN, WgpuBackend::Vulkan, "Vulkan");
#[cfg(all(feature = "metal", not(feature = "vulkan")))]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::METAL, WgpuBackend::Metal, "Metal");
#[cfg(not(any(feature = "vulkan", feature = "metal")))]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::VULKAN, WgpuBackend::Vulkan, "Vulkan");

/// Devices of which the runtime has a connection. The lock also keeps the instances of the programming interface on one
/// thread at a time: the Vulkan loader crashes if several threads create and drop them.
static OPEN: Mutex<Vec<WgpuDevice>> = Mutex::new(Vec::new());

/// Returns the adapters of the machine, the fastest kinds first; an empty list without a driver.
pub fn adapters() -> Vec<Adapter> {
    let _instances = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    list()
}

fn list() -> Vec<Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: API.0,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let found = cubecl::future::block_on(instance.enumerate_adapters(API.0));
    // the runtime counts the devices of every kind
    let mut counts = [0; 4];
    let mut next = |kind: usize| {
        counts[kind] += 1;
        counts[kind] - 1
    };
    let mut adapters: Vec<_> = found
        .iter()
        .map(|adapter| {
            let info = adapter.get_info();
            let (kind, device) = match info.device_type {
                wgpu::DeviceType::DiscreteGpu => (AdapterKind::Discrete, WgpuDeviceKind::DiscreteGpu(next(0))),
                wgpu::DeviceType::IntegratedGpu => (AdapterKind::Integrated, WgpuDeviceKind::IntegratedGpu(next(1))),
                wgpu::DeviceType::VirtualGpu => (AdapterKind::Virtual, WgpuDeviceKind::VirtualGpu(next(2))),
                wgpu::DeviceType::Cpu => (AdapterKind::Cpu, WgpuDeviceKind::Cpu),
                wgpu::DeviceType::Other => (AdapterKind::Other, WgpuDeviceKind::Other(next(3))),
            };
            let limits = adapter.limits();
            Adapter {
                name: info.name,
                kind,
                api: API.2.into(),
                driver: format!("{} {}", info.driver, info.driver_info).trim().into(),
                double: cfg!(feature = "vulkan") && adapter.features().contains(wgpu::Features::SHADER_F64),
                max_buffer: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
                device: WgpuDevice::new(device).on(API.1),
            }
        })
        .collect();
    adapters.sort_by_key(|adapter| adapter.kind);
    adapters
}

/// Connection to an adapter.
///
/// ```
/// use aviary_gpu::{GpuDevice, GpuError};
///
/// match GpuDevice::open(None) {
///     Ok(device) => println!("{}", device.adapter()),
///     Err(GpuError::NoAdapter { .. }) => println!("this machine has no GPU"),
///     Err(error) => return Err(error),
/// }
/// # Ok::<(), GpuError>(())
/// ```
#[derive(Clone)]
pub struct GpuDevice {
    adapter: Adapter,
    client: Client,
}

impl std::fmt::Debug for GpuDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GpuDevice").field("adapter", &self.adapter).finish_non_exhaustive()
    }
}

impl GpuDevice {
    /// Opens an adapter: the one whose index in [`adapters`] or part of whose name is `choice`, and the first one
    /// without a choice.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`], [`GpuError::UnknownAdapter`], and [`GpuError::Open`] if the driver refuses.
    pub fn open(choice: Option<&str>) -> Result<Self, GpuError> {
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        let mut adapters = list();
        if adapters.is_empty() {
            return Err(GpuError::NoAdapter { api: API.2 });
        }
        let chosen = choice.map_or(Some(0), |choice| choose(&adapters, choice));
        let Some(index) = chosen else {
            let adapters = adapters.iter().enumerate().map(|(index, adapter)| format!("{index} ({})", adapter.name));
            return Err(GpuError::UnknownAdapter {
                got: choice.unwrap_or_default().into(),
                adapters: adapters.collect(),
            });
        };
        let mut adapter = adapters.swap_remove(index);
        if !open.contains(&adapter.device) {
            let setup = cubecl::wgpu::try_init_setup::<AutoGraphicsApi>(&adapter.device, RuntimeOptions::default());
            if let Err(error) = setup {
                let GpuError::Device { message } = GpuError::device(&error) else { unreachable!("a device error") };
                return Err(GpuError::Open { adapter: adapter.name, message });
            }
            open.push(adapter.device.clone());
        }
        let client = cubecl::Device::Wgpu(adapter.device.clone()).client();
        let properties = client.properties();
        adapter.double &= properties.supports_type(ElemType::Float(FloatKind::F64));
        adapter.max_buffer = properties.memory.max_page_size;
        Ok(Self { adapter, client })
    }

    /// Returns the adapter.
    pub fn adapter(&self) -> &Adapter {
        &self.adapter
    }

    /// Returns the connection of the runtime.
    pub(crate) fn client(&self) -> &Client {
        &self.client
    }
}

/// Returns the adapter with an index or with a part of a name.
fn choose(adapters: &[Adapter], choice: &str) -> Option<usize> {
    let by_index = choice.parse().ok().filter(|index| *index < adapters.len());
    let name = choice.to_lowercase();
    by_index.or_else(|| adapters.iter().position(|adapter| adapter.name.to_lowercase().contains(&name)))
}

/// Opens the first adapter for a test of this crate; `None` without one, unless `AVIARY_REQUIRE_GPU` is set.
#[cfg(test)]
pub(crate) fn for_tests() -> Option<GpuDevice> {
    match GpuDevice::open(None) {
        Err(GpuError::NoAdapter { .. }) if std::env::var_os("AVIARY_REQUIRE_GPU").is_none() => None,
        device => Some(device.expect("an adapter that opens")),
    }
}
