#!/usr/bin/env bash
# Builds a container image of the Debian package, without a daemon and without a registry of images: a root made by debootstrap, the
# package in it, an image by buildah.
#
#   sudo docs/src/deploy/container.sh target/debian/eddy_0.1.0_amd64.deb [FOLDER]     writes FOLDER/eddy.oci.tar [default: target/container]
#
# Needs root, debootstrap and buildah. Podman and Docker read the archive: podman load --input eddy.oci.tar
set -euo pipefail
package=$(realpath "$1")
checkout=$(cd "$(dirname "$0")/../../.." && pwd)
folder=$(realpath -m "${2:-$checkout/target/container}")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root="$work/root"

debootstrap --variant=minbase bookworm "$root" >"$work/debootstrap.log" || { tail "$work/debootstrap.log" >&2; exit 1; }
cp "$package" "$root/eddy.deb"
chroot "$root" dpkg --install /eddy.deb >"$work/dpkg.log"
cp -r "$checkout/bags/sample" "$root/usr/share/eddy/sample"
rm -rf "$root/eddy.deb" "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root"/var/log/* "$root"/usr/share/doc/[!e]*
# The same user id in every image, so that containers that share /dev/shm can access each other's files.
chroot "$root" usermod --uid 10001 eddy
chroot "$root" chown -R eddy /var/lib/eddy

# Images of its own, which need no kernel module.
images=(--root "$work/images" --runroot "$work/run" --storage-driver vfs)
container=$(buildah "${images[@]}" from scratch)
buildah "${images[@]}" add --quiet "$container" "$root" / >"$work/added"
# eddy shuts down cleanly on SIGTERM, with its child processes (`eddy launch`).
buildah "${images[@]}" config --user eddy --workingdir /usr/share/eddy --stop-signal SIGTERM --entrypoint '["eddy"]' --cmd node \
    --label org.opencontainers.image.title=eddy "$container"
mkdir -p "$folder"
rm -f "$folder/eddy.oci.tar"
buildah "${images[@]}" commit --quiet --timestamp "${SOURCE_DATE_EPOCH:-0}" "$container" "oci-archive:$folder/eddy.oci.tar:eddy" >"$work/committed"
echo "$folder/eddy.oci.tar"
