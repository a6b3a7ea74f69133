//! The camera as a USB video class device (UVC 1.0): 8-bit grey over a bulk endpoint.
//!
//! Linux' uvcvideo takes it as it is: GREY at the rig's size; exposure and gain are controls. A picture is one payload; its
//! header carries the middle of the exposure in ticks of 100 ns.

use super::rig::{DeviceKind, Picture, UNIT_GAIN, VirtualRig};
use crate::usb_device::descriptor::{Configuration, Identity, TransferKind};
use crate::usb_device::{ControlReply, Descriptors, Outgoing, Setup, Speed, Transmit, UsbDevice};
use gv3_codec::GreyPicture;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Ticks of the camera's clock a second.
const CLOCK_HZ: u32 = 10_000_000;
const NANOS_A_TICK: u64 = 100;
/// Bytes before the pixels of a payload.
const HEADER_BYTES: u32 = 12;
/// Length of the probe and commit controls of UVC 1.0.
const PROBE_BYTES: usize = 26;
/// The pixels' endpoint.
const PIXELS: u8 = 1;
/// Entities of the control interface.
const CAMERA_TERMINAL: u8 = 1;
const PROCESSING_UNIT: u8 = 2;
/// Exposure times are told in units of 100 us.
const EXPOSURE_UNIT_NANOS: u64 = 100_000;
const MAX_EXPOSURE_UNITS: u32 = 10_000;
const MAX_GAIN: u16 = 16 * UNIT_GAIN;

/// Requests of the class.
const SET_CUR: u8 = 0x01;
const GET_CUR: u8 = 0x81;
const GET_MIN: u8 = 0x82;
const GET_MAX: u8 = 0x83;
const GET_RES: u8 = 0x84;
const GET_LEN: u8 = 0x85;
const GET_INFO: u8 = 0x86;
const GET_DEF: u8 = 0x87;

/// The camera.
pub struct UvcCamera {
    descriptors: Descriptors,
    rig: Arc<Mutex<VirtualRig>>,
    size_px: [u32; 2],
    /// Times between pictures that are offered, 100 ns, shortest first.
    intervals: Vec<u32>,
    interval: u32,
    default_exposure_units: u32,
    /// Toggles with every picture.
    frame_id: u8,
    sending: Option<Outgoing>,
}

impl UvcCamera {
    /// The camera of a rig, which delivers pictures of a size every `period_nanos` or at one of the usual rates.
    pub fn new(rig: Arc<Mutex<VirtualRig>>, size_px: [u32; 2], period_nanos: u64) -> Self {
        let own = u32::try_from(period_nanos / NANOS_A_TICK).unwrap_or(u32::MAX);
        let mut intervals = vec![own, CLOCK_HZ / 120, CLOCK_HZ / 90, CLOCK_HZ / 60, CLOCK_HZ / 30];
        intervals.sort_unstable();
        intervals.dedup();
        let exposure_nanos = rig.lock().unwrap_or_else(PoisonError::into_inner).camera.exposure_nanos;
        Self {
            descriptors: descriptors(size_px, &intervals, own),
            rig,
            size_px,
            intervals,
            interval: own,
            default_exposure_units: exposure_units(exposure_nanos),
            frame_id: 0,
            sending: None,
        }
    }

    fn rig(&self) -> MutexGuard<'_, VirtualRig> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn pixel_bytes(&self) -> u32 {
        self.size_px[0] * self.size_px[1]
    }

    /// Probe and commit (UVC 1.0, table 4-47): one format, one size, the interval nearest to the one asked for.
    fn probe(&self, interval: u32) -> Vec<u8> {
        let nearest = self.intervals.iter().copied().min_by_key(|i| i.abs_diff(interval)).unwrap_or(interval);
        let mut probe = vec![1, 0, 1, 1];
        probe.extend(nearest.to_le_bytes());
        probe.resize(18, 0);
        probe.extend(self.pixel_bytes().to_le_bytes());
        probe.extend((self.pixel_bytes() + HEADER_BYTES).to_le_bytes());
        probe
    }

    fn streaming_control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply {
        let is_commit = setup.value >> 8 == 2;
        let (shortest, longest) = (self.intervals[0], self.intervals[self.intervals.len() - 1]);
        match setup.request {
            SET_CUR => {
                let Some(&[_, _, _, _, a, b, c, d]) = data.first_chunk() else { return ControlReply::Stall };
                let set = self.probe(u32::from_le_bytes([a, b, c, d]));
                self.interval = u32::from_le_bytes([set[4], set[5], set[6], set[7]]);
                if is_commit {
                    (self.sending, self.frame_id) = (None, 0);
                    self.rig().camera.begin();
                }
                ControlReply::Done
            }
            GET_CUR | GET_DEF => ControlReply::Data(self.probe(self.interval)),
            GET_MIN => ControlReply::Data(self.probe(shortest)),
            GET_MAX => ControlReply::Data(self.probe(longest)),
            GET_LEN => ControlReply::Data(vec![PROBE_BYTES as u8, 0]),
            GET_INFO => ControlReply::Data(vec![3]),
            _ => ControlReply::Stall,
        }
    }

    /// Exposure mode, exposure, gain.
    fn picture_control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply {
        let [entity, _] = setup.index.to_be_bytes();
        let [selector, _] = setup.value.to_be_bytes();
        let current = {
            let rig = self.rig();
            (exposure_units(rig.camera.exposure_nanos), rig.camera.gain)
        };
        // Bytes, current, least, most, step and default.
        let (length, [now, least, most, step, default]) = match (entity, selector) {
            (CAMERA_TERMINAL, 2) => (1, [1, 1, 1, 1, 1]),
            (CAMERA_TERMINAL, 4) => (4, [current.0, 1, MAX_EXPOSURE_UNITS, 1, self.default_exposure_units]),
            (PROCESSING_UNIT, 4) => (2, [u32::from(current.1), 0, u32::from(MAX_GAIN), 1, u32::from(UNIT_GAIN)]),
            _ => return ControlReply::Stall,
        };
        let value = match setup.request {
            SET_CUR => return self.set_picture_control(entity, selector, data, least..=most),
            GET_CUR => now,
            GET_MIN => least,
            GET_MAX => most,
            GET_RES => step,
            GET_DEF => default,
            GET_LEN => return ControlReply::Data(vec![length as u8, 0]),
            GET_INFO => return ControlReply::Data(vec![3]),
            _ => return ControlReply::Stall,
        };
        ControlReply::Data(value.to_le_bytes()[..length].to_vec())
    }

    fn set_picture_control(
        &mut self,
        entity: u8,
        selector: u8,
        data: &[u8],
        range: std::ops::RangeInclusive<u32>,
    ) -> ControlReply {
        let mut bytes = [0; 4];
        if data.is_empty() || data.len() > 4 {
            return ControlReply::Stall;
        }
        bytes[..data.len()].copy_from_slice(data);
        let value = u32::from_le_bytes(bytes);
        if !range.contains(&value) {
            return ControlReply::Stall;
        }
        let mut rig = self.rig();
        match (entity, selector) {
            (CAMERA_TERMINAL, 4) => rig.camera.exposure_nanos = u64::from(value) * EXPOSURE_UNIT_NANOS,
            (PROCESSING_UNIT, 4) => rig.camera.gain = value as u16,
            _ => {}
        }
        ControlReply::Done
    }

    /// Header and pixels of a picture.
    fn payload(&mut self, picture: &Picture) -> Vec<u8> {
        let flags = 0x80 | 0x08 | 0x04 | 0x02 | self.frame_id;
        self.frame_id ^= 1;
        let ticks = ((picture.time_nanos / NANOS_A_TICK) as u32).to_le_bytes();
        let mut payload = Vec::with_capacity((self.pixel_bytes() + HEADER_BYTES) as usize);
        // End of header, source clock, presentation time, end of frame; time of the exposure, and no frame number of the bus.
        payload.extend([HEADER_BYTES as u8, flags]);
        payload.extend([ticks, ticks].concat());
        payload.extend([0, 0]);
        append_fitted(&picture.image, self.size_px, &mut payload);
        if picture.is_short {
            payload.truncate(payload.len() / 2);
        }
        payload
    }
}

fn exposure_units(nanos: u64) -> u32 {
    (nanos / EXPOSURE_UNIT_NANOS).clamp(1, u64::from(MAX_EXPOSURE_UNITS)) as u32
}

/// Appends a picture cut, or widened with black, to a size.
fn append_fitted(image: &GreyPicture, [width, height]: [u32; 2], out: &mut Vec<u8>) {
    if [image.width_px, image.height_px] == [width, height] {
        return out.extend_from_slice(&image.pixels);
    }
    let begin = out.len();
    for row in image.pixels.chunks_exact(image.width_px as usize).take(height as usize) {
        let end = out.len() + width as usize;
        out.extend_from_slice(&row[..row.len().min(width as usize)]);
        out.resize(end, 0);
    }
    out.resize(begin + width as usize * height as usize, 0);
}

fn descriptors(size_px: [u32; 2], intervals: &[u32], default_interval: u32) -> Descriptors {
    let identity = Identity {
        vendor_id: 0x1209,
        product_id: 0x0002,
        release: 0x0100,
        class: [0xef, 2, 1],
        manufacturer: "gv3".into(),
        product: "gv3 virtual camera".into(),
        serial: "virtual-camera-1".into(),
    };
    // Camera terminal with exposure mode and time, processing unit with gain, output terminal.
    let camera: &[u8] = &[18, 0x24, 2, CAMERA_TERMINAL, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0x0a, 0, 0];
    let processing: &[u8] = &[11, 0x24, 5, PROCESSING_UNIT, CAMERA_TERMINAL, 0, 0, 2, 0x00, 0x02, 0];
    let output: &[u8] = &[9, 0x24, 3, 3, 1, 1, 0, PROCESSING_UNIT, 0];
    let entities = [camera, processing, output].concat();
    let total = (13 + entities.len() as u16).to_le_bytes();
    let mut header = vec![0x24, 1, 0x00, 0x01, total[0], total[1]];
    header.extend(CLOCK_HZ.to_le_bytes());
    header.extend([1, 1]);
    let mut configuration = Configuration::new(Speed::Super).association(2, [14, 3, 0]).interface(0, [14, 1, 0]);
    configuration = configuration.class_descriptor(&header);
    for entity in [camera, processing, output] {
        configuration = configuration.class_descriptor(&entity[1..]);
    }
    configuration = configuration.interface(1, [14, 2, 0]);
    for part in streaming_descriptors(size_px, intervals, default_interval) {
        configuration = configuration.class_descriptor(&part);
    }
    Descriptors::new(identity, configuration.endpoint(0x80 | PIXELS, TransferKind::Bulk))
}

/// Input header, the grey format, its one size, colour matching; each without its length byte.
fn streaming_descriptors([width, height]: [u32; 2], intervals: &[u32], default_interval: u32) -> [Vec<u8>; 4] {
    let bytes = width * height;
    let bits_a_second = |interval: u32| (u64::from(bytes) * 8 * u64::from(CLOCK_HZ) / u64::from(interval)) as u32;
    let mut size = vec![0x24, 5, 1, 0];
    size.extend((width as u16).to_le_bytes());
    size.extend((height as u16).to_le_bytes());
    let (shortest, longest) = (intervals[0], intervals[intervals.len() - 1]);
    for value in [bits_a_second(longest), bits_a_second(shortest), bytes, default_interval] {
        size.extend(value.to_le_bytes());
    }
    size.push(intervals.len() as u8);
    size.extend(intervals.iter().flat_map(|i| i.to_le_bytes()));
    // Y800, eight bits a pixel.
    let mut format = vec![0x24, 4, 1, 1];
    format.extend(b"Y800\x00\x00\x10\x00\x80\x00\x00\xaa\x00\x38\x9b\x71");
    format.extend([8, 1, 0, 0, 0, 0]);
    let colours = vec![0x24, 0x0d, 1, 1, 4];
    let total = (14 + format.len() + 1 + size.len() + 1 + colours.len() + 1) as u16;
    let [low, high] = total.to_le_bytes();
    let header = vec![0x24, 1, 1, low, high, 0x80 | PIXELS, 0, 3, 0, 0, 0, 1, 0];
    [header, format, size, colours]
}

impl UsbDevice for UvcCamera {
    fn descriptors(&self) -> &Descriptors {
        &self.descriptors
    }

    fn control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply {
        // Clearing the endpoint's halt is how a host ends a stream that has no alternate setting to leave.
        if (setup.request_type, setup.request, setup.index) == (0x02, 1, 0x80 | u16::from(PIXELS)) {
            self.rig().camera.end();
            self.sending = None;
        }
        if let Some(reply) = self.descriptors.answer(setup) {
            return reply;
        }
        match (setup.request_type, setup.index) {
            (0x21 | 0xa1, 1) => self.streaming_control(setup, data),
            (0x21 | 0xa1, index) if index & 0xff == 0 => self.picture_control(setup, data),
            _ => ControlReply::Stall,
        }
    }

    fn receive(&mut self, _endpoint: u8, _data: &[u8]) -> bool {
        false
    }

    fn transmit(&mut self, endpoint: u8, max_bytes: usize) -> Transmit {
        if endpoint != PIXELS {
            return Transmit::Stall;
        }
        if self.sending.is_none() {
            let Some(picture) = self.rig().take_picture(Instant::now()) else { return Transmit::Nothing };
            let payload = self.payload(&picture);
            // A whole payload ends with its length, another with a short packet.
            self.sending = Some(match picture.is_short {
                true => Outgoing::new(payload),
                false => Outgoing::stream(payload),
            });
        }
        let Some(sending) = &mut self.sending else { return Transmit::Nothing };
        let (part, is_last) = sending.next(max_bytes);
        if is_last {
            self.sending = None;
        }
        Transmit::Data(part)
    }

    fn reset(&mut self) {
        self.sending = None;
        self.rig().camera.end();
    }

    fn take_unplug(&mut self) -> bool {
        self.rig().take_unplug(DeviceKind::Camera)
    }
}
