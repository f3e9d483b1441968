#!/usr/bin/env bash
# Builds a Debian package of built programs: `eddy`, `eddy-lab` beside it, manual pages, completions, systemd unit, settings and
# message definitions.
#
#   docs/src/deploy/debian.sh target/release/eddy [FOLDER]     writes FOLDER/eddy_VERSION_ARCHITECTURE.deb [default: target/debian]
#
# The package is for the machine that it was built on or a newer one: it depends on the libraries that the programs link with, in the
# versions found here. The same programs give the same bytes. Needs dpkg-dev.
set -euo pipefail
program=$(realpath "$1")
root=$(cd "$(dirname "$0")/../../.." && pwd)
folder=$(realpath -m "${2:-$root/target/debian}")

version=$("$program" --version | cut -d' ' -f2)
architecture=$(dpkg --print-architecture)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
tree="$work/eddy"

# The build id is a hash over symbol names, which rustc does not choose the same in every build.
for name in eddy eddy-lab; do
    strip --remove-section=.note.gnu.build-id -o "$work/program" "$(dirname "$program")/$name"
    install -D "$work/program" "$tree/usr/bin/$name"
done

"$program" --quiet man "$work/man"
install -d "$tree/usr/share/man/man1"
for page in "$work"/man/*.1; do
    gzip -9n <"$page" >"$tree/usr/share/man/man1/$(basename "$page").gz"
done
complete() { install -d "$tree/$(dirname "$2")" && "$program" completions "$1" >"$tree/$2"; }
complete bash usr/share/bash-completion/completions/eddy
complete zsh usr/share/zsh/vendor-completions/_eddy
complete fish usr/share/fish/vendor_completions.d/eddy.fish

# The unit that the documentation describes, with the paths of a package.
install -d "$tree/lib/systemd/system" "$tree/usr/lib/sysusers.d"
sed -e 's|/usr/local/bin/eddy|/usr/bin/eddy|' -e 's|file:/usr/local/share/doc|file:/usr/share/doc|' \
    "$root/docs/src/deploy/eddy-node.service" >"$tree/lib/systemd/system/eddy-node.service"
echo 'u eddy - "eddy node" /var/lib/eddy' >"$tree/usr/lib/sysusers.d/eddy.conf"
install -D -m 644 "$root/launch_configs/node/lookahead.toml" "$tree/etc/eddy/node.toml"

install -d "$tree/usr/share/eddy/bags" "$tree/usr/share/doc/eddy"
cp -r "$root/launch_configs" "$root/msgs" "$root/docs/src/deploy/eddy_ros" "$tree/usr/share/eddy/"
cp -r "$root/bags/sample" "$tree/usr/share/eddy/bags/"
cp "$root/docs/src/deploy/README.md" "$root/LICENSE-APACHE" "$root/LICENSE-MIT" "$tree/usr/share/doc/eddy/"
gzip -9n <"$root/CHANGELOG.md" >"$tree/usr/share/doc/eddy/changelog.gz"
cat >"$tree/usr/share/doc/eddy/copyright" <<'TEXT'
Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/
Upstream-Name: eddy

Files: *
Copyright: the eddy developers
License: Apache-2.0 or MIT
 See LICENSE-APACHE and LICENSE-MIT in this folder.
TEXT

# The libraries that the programs link with.
install -d "$work/debian" && touch "$work/debian/control"
depends=$(cd "$work" && dpkg-shlibdeps -O "$tree/usr/bin/eddy" "$tree/usr/bin/eddy-lab" | sed 's/^shlibs:Depends=//')
size=$(du -sk "$tree" | cut -f1)
install -d "$tree/DEBIAN"
cat >"$tree/DEBIAN/control" <<TEXT
Package: eddy
Version: $version
Architecture: $architecture
Maintainer: the eddy developers <eddy@localhost>
Installed-Size: $size
Depends: $depends
Recommends: systemd
Section: science
Priority: optional
Description: recurrent surrogates for particle simulations
 Nodes that predict the next frames of particle simulations with minGRU and
 minLSTM networks, over shared memory, Zenoh or DDS; with a Material Point
 Method solver, training, evaluation, and recording and replay of MCAP bags.
 ROS 2 is not needed.
TEXT
echo /etc/eddy/node.toml >"$tree/DEBIAN/conffiles"
cat >"$tree/DEBIAN/postinst" <<'TEXT'
#!/bin/sh
set -e
# The user of the unit; the unit is not enabled.
if [ "$1" = configure ]; then
    if command -v systemd-sysusers >/dev/null; then
        systemd-sysusers eddy.conf
    elif ! getent passwd eddy >/dev/null; then
        useradd --system --home-dir /var/lib/eddy eddy
    fi
    install -d -o eddy -g eddy /var/lib/eddy
    if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
fi
TEXT
cat >"$tree/DEBIAN/prerm" <<'TEXT'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then systemctl stop eddy-node.service; fi
TEXT
chmod 755 "$tree/DEBIAN/postinst" "$tree/DEBIAN/prerm"

# Equal bytes each time: one date for all files, no user names.
chmod -R u=rwX,go=rX "$tree"
export SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-0}"
find "$tree" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
mkdir -p "$folder"
dpkg-deb --root-owner-group -Zxz --build "$tree" "$folder/eddy_${version}_$architecture.deb"
