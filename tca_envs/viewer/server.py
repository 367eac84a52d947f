"""Visitors come and go: each gets a page and a thread of its own."""

import logging
import threading

from tca_envs import registry
from tca_envs.viewer.page import CAMERA, LOOK_AT, VIEW_RAD, Page, viser
from tca_envs.viewer.session import Session

log = logging.getLogger(__name__)


class Server(viser.ViserServer):
    """viser's, which no visitor can show to the world."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Open no tunnel: viser does for every browser that asks, its button hidden or not."""


class Viewer:
    """A running web server.

    Parameters
    ----------
    host : str
        Address to bind to.
    port : int
        0 for any free one; `url` tells which.
    task : str
        What pages begin with.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080, task: str = "reach") -> None:
        self.task = registry.entry(task).name
        self.server = Server(host, port, verbose=False)
        self.server.scene.set_up_direction("-z")
        self.server.initial_camera.position, self.server.initial_camera.look_at = CAMERA, LOOK_AT
        self.server.initial_camera.fov = VIEW_RAD
        # An environment map takes a browser without a graphics card ten seconds to begin with. What it would light: beside
        # viser's own lamp above, which throws the shadows, all of it a little, and what hangs from the front.
        self.server.scene.configure_environment_map(None)
        self.server.scene.add_light_ambient("/all", intensity=1.3)
        self.server.scene.add_light_directional("/front", intensity=1.5, position=(6.0, 12.0, -4.0))
        for entry in registry.entries():  # the first step compiles kernels or reads them from a cache
            Session(entry.name).step()
        self.pages: dict[int, Page] = {}
        """Of the visitors that are there, by viser's number of the client."""
        self.server.on_client_disconnect(self._leave)
        self.server.on_client_connect(self._come)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Send all visitors away and end."""
        for page in list(self.pages.values()):
            page.leave()
        self.server.stop()

    def _come(self, client: viser.ClientHandle) -> None:
        threading.Thread(target=self._serve, args=(client,), name=f"visitor {client.client_id}", daemon=True).start()

    def _serve(self, client: viser.ClientHandle) -> None:
        try:
            page = self.pages[client.client_id] = Page(client, self.task)
            if client.client_id not in self.server.get_clients():
                page.leave()  # gone while the page was made
            page.run()
        except Exception as error:
            # No visitor's fault is another one's; and one who has gone in the middle of something made none.
            if client.client_id in self.server.get_clients():
                log.exception("the page of visitor %d has stopped", client.client_id)
                client.add_notification("This page has stopped", f"{error}. Reload it to begin again.", color="red")
        finally:
            self.pages.pop(client.client_id, None)

    def _leave(self, client: viser.ClientHandle) -> None:
        if page := self.pages.get(client.client_id):
            page.leave()
