//! Buffers and controls of a V4L2 device, where the crate `v4l` cannot be used: everything that needs unsafe, behind calls that
//! keep its rules.
#![allow(unsafe_code)]

use crate::device::in_use;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::ffi::c_void;
use std::io::{self, ErrorKind};
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};
use v4l::Device;
use v4l::v4l_sys as sys;
use v4l::v4l2::{self, vidioc};

const CAPTURE: u32 = sys::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE;
const MMAP: u32 = sys::v4l2_memory_V4L2_MEMORY_MMAP;
/// No picture is larger, bytes.
const MAX_BUFFER_BYTES: u32 = 1 << 28;
/// Controls of one device beyond which it is taken for broken.
const MAX_CONTROLS: usize = 1024;

/// A structure of the kernel's that is plain numbers.
///
/// # Safety
/// All bytes zero must be a valid value.
unsafe trait Plain: Sized {
    fn zeroed() -> Self {
        // SAFETY: the implementer of the trait promises that zeros are a valid value.
        unsafe { std::mem::zeroed() }
    }
}

// SAFETY: numbers, and unions of numbers and pointers, of which null is one.
unsafe impl Plain for sys::v4l2_buffer {}
// SAFETY: numbers.
unsafe impl Plain for sys::v4l2_requestbuffers {}
// SAFETY: numbers.
unsafe impl Plain for sys::v4l2_query_ext_ctrl {}
// SAFETY: numbers, and a union of them.
unsafe impl Plain for sys::v4l2_querymenu {}

/// # Safety
/// `T` must be the structure that `request` takes.
unsafe fn ioctl<T>(device: &Device, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
    loop {
        // SAFETY: the argument lives through the call; its type is the caller's promise.
        let done = unsafe { v4l2::ioctl(device.handle().fd(), request, std::ptr::from_mut(argument).cast::<c_void>()) };
        if !done.as_ref().is_err_and(|e| e.kind() == ErrorKind::Interrupted) {
            return done;
        }
    }
}

/// A buffer of the driver's in this process.
struct Mapping {
    start: *mut c_void,
    length: usize,
}

// SAFETY: a mapping belongs to the process, not to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(device: &Device, index: u32) -> io::Result<Self> {
        let mut buffer = sys::v4l2_buffer { index, type_: CAPTURE, memory: MMAP, ..Plain::zeroed() };
        // SAFETY: VIDIOC_QUERYBUF takes a v4l2_buffer.
        unsafe { ioctl(device, vidioc::VIDIOC_QUERYBUF, &mut buffer)? };
        if buffer.length == 0 || buffer.length > MAX_BUFFER_BYTES {
            return Err(io::Error::other(format!("the driver's buffers are {} bytes long", buffer.length)));
        }
        let length = buffer.length as usize;
        // SAFETY: for memory of the kind MMAP the driver has filled in the offset; a new mapping touches no other.
        let start = unsafe {
            let offset = i64::from(buffer.m.offset);
            v4l2::mmap(std::ptr::null_mut(), length, PROT_READ, MAP_SHARED, device.handle().fd(), offset)?
        };
        Ok(Self { start, length })
    }
}

/// Keeps other processes that ask for it from the device for as long as this one has it open.
///
/// # Errors
/// EBUSY when another has it.
pub(super) fn lock(device: &Device) -> io::Result<()> {
    // SAFETY: the device is open for the length of the call.
    in_use::lock(unsafe { BorrowedFd::borrow_raw(device.handle().fd()) })
}

/// As in Linux's mman.h, on every machine.
const PROT_READ: i32 = 1;
const MAP_SHARED: i32 = 1;

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped with this length, and no slice of it outlives `Queue::next`.
        // A failure would leave the mapping to the end of the process, which harms nothing.
        let _ = unsafe { v4l2::munmap(self.start, self.length) };
    }
}

/// What the driver tells of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BufferStamp {
    /// `V4L2_BUF_FLAG_*`.
    pub flags: u32,
    /// Pictures since the stream began, those the driver lost included.
    pub sequence: u32,
    /// On one of the kernel's clocks, nanoseconds.
    pub time_nanos: u64,
}

/// A running stream. A buffer is given back to the driver when it was taken from it, and never otherwise.
pub(super) struct Queue {
    mappings: Vec<Mapping>,
    device: Arc<Device>,
}

impl Queue {
    /// Maps `count` buffers, or as many as the driver gives, hands them all to it and starts the stream.
    pub fn start(device: Arc<Device>, count: u32) -> io::Result<Self> {
        let given = request_buffers(&device, count)?;
        let mut queue = Self { mappings: Vec::new(), device };
        for index in 0..given {
            queue.mappings.push(Mapping::new(&queue.device, index)?);
            queue.enqueue(index)?;
        }
        if queue.mappings.is_empty() {
            return Err(io::Error::other("the driver gives no buffers"));
        }
        stream(&queue.device, vidioc::VIDIOC_STREAMON)?;
        Ok(queue)
    }

    /// Waits for the next filled buffer, shows it to `read`, and gives it back. `None` when there was none by the deadline;
    /// then nothing was taken and nothing is given back, and the stream goes on.
    ///
    /// # Errors
    /// ENODEV when the device is gone; any other error of the driver's.
    pub fn next<T>(&mut self, deadline: Instant, read: impl FnOnce(&[u8], BufferStamp) -> T) -> io::Result<Option<T>> {
        loop {
            let ready = self.wait(deadline)?;
            if ready.is_empty() {
                return Ok(None);
            }
            // POLLERR and POLLHUP do not say what is wrong; taking a buffer does.
            match self.dequeue() {
                Ok(buffer) => return self.show(&buffer, read).map(Some),
                Err(e) if e.kind() == ErrorKind::WouldBlock && !ready.intersects(PollFlags::ERR | PollFlags::HUP) => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    return Err(io::Error::other("the stream has stopped (POLLERR)"));
                }
                Err(e) => return Err(e),
            }
        }
    }

    fn wait(&self, deadline: Instant) -> io::Result<PollFlags> {
        // SAFETY: the device is open as long as the queue holds it.
        let fd = unsafe { BorrowedFd::borrow_raw(self.device.handle().fd()) };
        loop {
            let left = deadline.saturating_duration_since(Instant::now()).min(Duration::from_secs(3600));
            let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
            let mut fds = [PollFd::from_borrowed_fd(fd, PollFlags::IN)];
            match poll(&mut fds, Some(&timeout)) {
                Ok(_) => return Ok(fds[0].revents()),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(e.into()),
            }
        }
    }

    fn dequeue(&self) -> io::Result<sys::v4l2_buffer> {
        let mut buffer = sys::v4l2_buffer { type_: CAPTURE, memory: MMAP, ..Plain::zeroed() };
        // SAFETY: VIDIOC_DQBUF takes a v4l2_buffer.
        unsafe { ioctl(&self.device, vidioc::VIDIOC_DQBUF, &mut buffer)? };
        Ok(buffer)
    }

    fn show<T>(&self, buffer: &sys::v4l2_buffer, read: impl FnOnce(&[u8], BufferStamp) -> T) -> io::Result<T> {
        let mapping = self.mappings.get(buffer.index as usize);
        let mapping = mapping.ok_or_else(|| io::Error::other("the driver filled a buffer that it was not given"))?;
        let used = (buffer.bytesused as usize).min(mapping.length);
        // SAFETY: mapped for reading with at least this length; the driver leaves a buffer alone between DQBUF and QBUF, and
        // the slice ends before the buffer is given back.
        let bytes = unsafe { std::slice::from_raw_parts(mapping.start.cast::<u8>(), used) };
        let time = &buffer.timestamp;
        let time_nanos = (time.tv_sec as u64).wrapping_mul(1_000_000_000).wrapping_add(time.tv_usec as u64 * 1000);
        let shown = read(bytes, BufferStamp { flags: buffer.flags, sequence: buffer.sequence, time_nanos });
        self.enqueue(buffer.index)?;
        Ok(shown)
    }

    fn enqueue(&self, index: u32) -> io::Result<()> {
        let mut buffer = sys::v4l2_buffer { index, type_: CAPTURE, memory: MMAP, ..Plain::zeroed() };
        // SAFETY: VIDIOC_QBUF takes a v4l2_buffer.
        unsafe { ioctl(&self.device, vidioc::VIDIOC_QBUF, &mut buffer) }
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        // The device may be gone already; its buffers are freed with the last mapping either way.
        let _ = stream(&self.device, vidioc::VIDIOC_STREAMOFF);
        self.mappings.clear();
        let _ = request_buffers(&self.device, 0);
    }
}

fn request_buffers(device: &Device, count: u32) -> io::Result<u32> {
    let mut request = sys::v4l2_requestbuffers { count, type_: CAPTURE, memory: MMAP, ..Plain::zeroed() };
    // SAFETY: VIDIOC_REQBUFS takes a v4l2_requestbuffers.
    unsafe { ioctl(device, vidioc::VIDIOC_REQBUFS, &mut request)? };
    Ok(request.count)
}

fn stream(device: &Device, request: vidioc::_IOC_TYPE) -> io::Result<()> {
    let mut kind = CAPTURE as i32;
    // SAFETY: VIDIOC_STREAMON and VIDIOC_STREAMOFF take an int.
    unsafe { ioctl(device, request, &mut kind) }
}

/// A control of one value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Control {
    pub id: u32,
    pub name: String,
    pub is_switch: bool,
    pub is_menu: bool,
    pub is_read_only: bool,
    pub minimum: i64,
    pub maximum: i64,
    pub step: u64,
}

/// Controls of numbers, switches and menus. The crate's own enumeration panics at a kind that it does not know.
pub(super) fn controls(device: &Device) -> Vec<Control> {
    let (mut found, mut query) = (Vec::new(), sys::v4l2_query_ext_ctrl::zeroed());
    for _ in 0..MAX_CONTROLS {
        query.id |= sys::V4L2_CTRL_FLAG_NEXT_CTRL;
        // SAFETY: VIDIOC_QUERY_EXT_CTRL takes a v4l2_query_ext_ctrl.
        if unsafe { ioctl(device, vidioc::VIDIOC_QUERY_EXT_CTRL, &mut query) }.is_err() {
            break;
        }
        let is_menu = query.type_ == sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_MENU;
        let is_switch = query.type_ == sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_BOOLEAN;
        let numbers = [sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER, sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER64];
        if query.flags & sys::V4L2_CTRL_FLAG_DISABLED == 0 && (is_menu || is_switch || numbers.contains(&query.type_)) {
            found.push(Control {
                id: query.id,
                name: text(query.name.iter().map(|c| *c as u8)),
                is_switch,
                is_menu,
                is_read_only: query.flags & sys::V4L2_CTRL_FLAG_READ_ONLY != 0,
                minimum: query.minimum,
                maximum: query.maximum,
                step: query.step,
            });
        }
    }
    found
}

/// Names of a menu's items with their values.
pub(super) fn menu(device: &Device, control: &Control) -> Vec<(i64, String)> {
    let item = |value: i64| {
        let mut query = sys::v4l2_querymenu { id: control.id, index: value as u32, ..Plain::zeroed() };
        // SAFETY: VIDIOC_QUERYMENU takes a v4l2_querymenu. A driver refuses the values that it leaves out.
        unsafe { ioctl(device, vidioc::VIDIOC_QUERYMENU, &mut query) }.ok()?;
        // SAFETY: of a menu that is none of integers the name is what the driver wrote.
        Some((value, text(unsafe { query.__bindgen_anon_1.name }.into_iter())))
    };
    (control.minimum.max(0)..=control.maximum.min(1024)).filter_map(item).collect()
}

fn text(bytes: impl Iterator<Item = u8>) -> String {
    let bytes: Vec<u8> = bytes.take_while(|b| *b != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}
